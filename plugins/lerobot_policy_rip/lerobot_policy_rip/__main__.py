"""Make the folder of a policy: ``python -m lerobot_policy_rip --demonstrations=DIR --arms='[{model: …}]' --out=DIR``.

The options are the fields of `RipConfig`.
"""

from __future__ import annotations

import argparse
import sys

import draccus

from robust_instant_policy.errors import RipError

from .configuration_rip import RipConfig
from .modeling_rip import RipPolicy
from .processor_rip import make_rip_pre_post_processors


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, add_help=False)
    parser.add_argument("--out", required=True)
    options, rest = parser.parse_known_args()
    try:
        config = draccus.parse(RipConfig, args=rest)
        policy = RipPolicy(config)
    except RipError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    policy.save_pretrained(options.out)
    for processor in make_rip_pre_post_processors(config):
        processor.save_pretrained(options.out)
    print(f"{options.out}: use it with --policy.path={options.out}; actions: {', '.join(config.action_feature_names)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
