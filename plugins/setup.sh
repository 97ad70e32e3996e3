#!/usr/bin/env bash
# Makes an environment with LeRobot, this package and its plugins; can be repeated.
#   plugins/setup.sh [DIR] [VERSION]     default: .venv-lerobot, LeRobot 0.6.1 (6 GB); 0.4.4 is the newest for Python 3.11
set -euo pipefail
env=$(realpath -m "${1:-.venv-lerobot}") version=${2:-0.6.1}
cd "$(dirname "$0")/.."

case $version in
  0.6.*) pythons="python3.12 python3.13" lerobot="lerobot[core-scripts,evaluation]==$version" plugins="policy robot env" ;;
  0.4.*) pythons="python3.11 python3.12" lerobot="lerobot==$version" plugins="policy robot" ;;
  *) echo "plugins/setup.sh: LeRobot 0.4 and 0.6 are supported, not $version" >&2; exit 2 ;;
esac
if [ ! -x "$env/bin/python" ]; then
  for python in $pythons; do
    if "$python" -c 'import venv, ensurepip' 2>/dev/null; then break; fi
    python=
  done
  [ -n "$python" ] || { echo "plugins/setup.sh: LeRobot $version needs one of $pythons" >&2; exit 1; }
  "$python" -m venv "$env"
fi
pip=("$env/bin/python" -m pip install --quiet --disable-pip-version-check)
"${pip[@]}" "$lerobot" pytest pytest-xdist filelock -e '.[sim,aloha,vision,embedded,robots]'
for plugin in $plugins; do
  "${pip[@]}" --no-deps -e "plugins/lerobot_${plugin}_rip"
done
echo "$env: $("$env/bin/python" -c 'import importlib.metadata as m; print("lerobot", m.version("lerobot"))') with the plugins"
