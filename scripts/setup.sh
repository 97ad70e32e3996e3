#!/usr/bin/env bash
# Makes .venv/ with everything that `make demo` and `make test` need, system packages included.
# Can be repeated: it ends at once if nothing changed.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly TORCH=$(grep '^torch==' constraints.txt)
readonly TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
readonly STAMP=.venv/setup-stamp
readonly LOG=$(mktemp)
trap 'rm -f "$LOG"' EXIT

say() { printf '\033[1m[setup]\033[0m %s\n' "$*"; }
die() { printf '[setup] %s\n' "$*" >&2; exit 1; }

# Runs a command silently; prints all of its output if it fails.
logged() { "$@" >"$LOG" 2>&1 </dev/null || { cat "$LOG" >&2; return 1; }; }

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else return 1; fi
}

apt_get() {
  logged as_root env DEBIAN_FRONTEND=noninteractive apt-get -y --no-install-recommends -o DPkg::Lock::Timeout=120 "$@"
}

apt_ready=
apt_install() {
  command -v apt-get >/dev/null || return 1
  if [ -z "$apt_ready" ]; then
    say "reading the package lists"
    logged as_root dpkg --configure -a || return 1 # completes an interrupted installation
    apt_get update || return 1
    apt_ready=1
  fi
  say "installing system packages: $*"
  apt_get install "$@"
}

find_python() {
  local candidate
  for candidate in python3.11 python3.12 python3.13 python3; do
    if command -v "$candidate" >/dev/null &&
      "$candidate" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  return 1
}

fingerprint() { cat pyproject.toml constraints.txt scripts/setup.sh | sha256sum | cut -d' ' -f1; }

# Prints nothing and succeeds if the simulator can render an image on this machine.
renderer_works() { .venv/bin/python -m robust_instant_policy.tasks.maniskill.renderer >/dev/null 2>&1; }

mesa_version() { dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || echo 'of an unknown version'; }

mujoco_renders() { .venv/bin/python -m robust_instant_policy.tasks.aloha.renderer >/dev/null 2>&1; }

add_debian_backports() {
  # Debian 12's own Mesa (22.3) lacks the descriptor indexing that SAPIEN needs; its backports have 25.
  local list=/etc/apt/sources.list.d/robust-instant-policy-backports.sources
  [ -e "$list" ] && return
  local mirror
  mirror=$(grep -rhoE 'https?://[^ ]+/debian/?( |$)' /etc/apt/sources.list /etc/apt/sources.list.d 2>/dev/null |
    grep -v -e snapshot -e security | head -n 1 | tr -d ' ')
  printf 'Types: deb\nURIs: %s\nSuites: bookworm-backports\nComponents: main\nSigned-By: %s\n' \
    "${mirror:-http://deb.debian.org/debian}" /usr/share/keyrings/debian-archive-keyring.gpg |
    as_root tee "$list" >/dev/null
  apt_ready=
}

install_vulkan() {
  say "no Vulkan driver that the simulator accepts; installing Mesa's CPU driver"
  local id= codename=
  [ -r /etc/os-release ] && id=$(. /etc/os-release && echo "$ID") && codename=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
  if [ "$id/$codename" = debian/bookworm ]; then
    add_debian_backports && apt_install libvulkan1 && apt_get install -t bookworm-backports mesa-vulkan-drivers
  else
    apt_install libvulkan1 mesa-vulkan-drivers
  fi
}

if [ -f "$STAMP" ] && [ "$(cat "$STAMP")" = "$(fingerprint)" ]; then
  exit 0
fi

case "$(uname -s)/$(uname -m)" in
  Linux/x86_64) ;;
  *) die "this set-up covers Linux on x86-64; elsewhere: pip install -e '.[sim,aloha,vision,embedded]' and a Vulkan driver" ;;
esac

python=$(find_python) || {
  apt_install python3 python3-venv || true
  python=$(find_python) ||
    die "needs Python 3.11, 3.12 or 3.13 with venv; install it (Debian 12 or 13, Ubuntu 24.04: apt install python3 python3-venv) and run again"
}
say "using $($python --version)"

# Libraries that wheels link to but do not carry: OpenCV's OpenGL, the simulator's Vulkan loader and X11, RealSense's libusb.
missing=()
for library in libGL.so.1:libgl1 libX11.so.6:libx11-6 libvulkan.so.1:libvulkan1 libgomp.so.1:libgomp1 libglib-2.0.so.0:libglib2.0-0 libusb-1.0.so.0:libusb-1.0-0; do
  ldconfig -p 2>/dev/null | grep -q "${library%%:*}" || /sbin/ldconfig -p | grep -q "${library%%:*}" || missing+=("${library##*:}")
done
[ -e /etc/ssl/certs/ca-certificates.crt ] || missing+=(ca-certificates)
command -v git >/dev/null || missing+=(git) # imported by ManiSkill through GitPython
if [ ${#missing[@]} -gt 0 ]; then
  apt_install "${missing[@]}" || die "needs the system packages ${missing[*]}; install them and run again"
fi

.venv/bin/python -m pip --version >/dev/null 2>&1 || logged "$python" -m venv --clear .venv || die "could not create .venv"
# pip writes INSTALLER after a package's files: where it is missing, pip was killed and must install the package again.
for package in .venv/lib/python3*/site-packages/*.dist-info; do
  [ -e "$package/INSTALLER" ] || rm -rf "$package"
done
pip_install() {
  logged .venv/bin/python -m pip install --disable-pip-version-check --no-input "$@"
}

if ! .venv/bin/python -c 'import torch' 2>/dev/null; then
  # The plain index serves a build with several GB of CUDA; prefer the CPU build if its index can be reached.
  index=()
  if "$python" -c "import urllib.request as u; u.urlopen('$TORCH_CPU_INDEX/torch/', timeout=5)" 2>/dev/null; then
    index=(--index-url "$TORCH_CPU_INDEX" --extra-index-url https://pypi.org/simple)
  fi
  say "installing PyTorch"
  pip_install -c constraints.txt "${index[@]}" "$TORCH" || die "PyTorch could not be installed; the output of pip is above"
fi
# constraints.txt lists every package, so pip need not resolve: ManiSkill and gym-aloha require two packages that do not
# install on Python 3.13 and that nothing here imports; metaworld requires an older mujoco than this project uses.
say "installing the package and its dependencies"
{ pip_install --no-deps -r constraints.txt && pip_install --no-deps -e .; } ||
  die "the dependencies could not be installed; the output of pip is above"
lacking=$(.venv/bin/python -m pip check | grep -vE ' requires (mplib|dm-control), |^metaworld .* requirement mujoco|^No broken' || true)
[ -z "$lacking" ] || die "constraints.txt is incomplete: $lacking"

if ! mujoco_renders; then
  say "no OpenGL for rendering without a screen; installing Mesa"
  apt_install libegl1 libgl1-mesa-dri || true
  mujoco_renders || apt_install libosmesa6 || true
  mujoco_renders || die "needs OpenGL without a screen; install libegl1 and libgl1-mesa-dri, or libosmesa6, and run again"
fi
if ! renderer_works; then
  install_vulkan || die "needs a Vulkan driver; install mesa-vulkan-drivers (Mesa 25 or newer) and run again"
  renderer_works || die "the simulator still finds no renderer with Mesa $(mesa_version); it needs 25 or newer \
(Ubuntu 24.04: enable noble-updates and run again); see: .venv/bin/rip doctor"
fi

# The tests of `rip studio` look at its page in Chromium; without it they are skipped.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  if [ -r /etc/os-release ] && [ "$(. /etc/os-release && echo "$ID")" = debian ]; then
    apt_install chromium || say "Chromium could not be installed; the tests of rip studio will be skipped"
  else
    say "no Chromium: the tests of rip studio will be skipped (on Ubuntu: sudo snap install chromium)"
  fi
fi

# The test of the SpaceMouse runs the system's HIDAPI on an emulated device; without them it is skipped.
if ! command -v umockdev-run >/dev/null; then
  apt_install libhidapi-hidraw0 umockdev || say "umockdev could not be installed; the test of the SpaceMouse will be skipped"
fi

fingerprint >"$STAMP"
say "done; the command is .venv/bin/rip"
