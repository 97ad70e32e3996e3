"""How near the links of one arm come to each other in demonstrations of the simulated tasks.

    python benchmarks/robot_links.py [--seeds 10]

A demonstration becomes joint commands as for execution, on the arms that come with the package; every command is
measured as `rip run` checks it. A distance below `link_distance` would be a false alarm.
"""

from __future__ import annotations

import argparse

from robust_instant_policy.motion.capsules import ArmShape
from robust_instant_policy.motion.limits import LINK_DISTANCE_M
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.tasks import TASK_NAMES, make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

RATE_HZ = 50.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = range(parser.parse_args().seeds)
    shapes = {
        cell: ArmShape(arm_of(CellConfig.load(f"emulated-{cell}").arms[0]).kinematics) for cell in ("aloha", "ur5e")
    }
    for name in TASK_NAMES:
        shape, task = shapes["aloha" if name.startswith("aloha") else "ur5e"], make_task(name)
        assert isinstance(task, SimulatedTask)
        least = []
        for attempt in map(task.demonstrate, seeds):
            demonstration = attempt.demonstration
            motion = plan_waypoints(demonstration.trajectory, task.arms, demonstration.rate_hz, RATE_HZ)
            for joints in motion.joints.swapaxes(0, 1):
                apart = shape.at(joints).between(*shape.pairs).min(axis=0)
                pair = shape.pairs[:, apart.argmin()]
                least.append((float(apart.min()), " and ".join(shape.links[index] for index in pair)))
        alarms = sum(distance < LINK_DISTANCE_M for distance, _ in least)
        print(f"{name}: {len(least)} paths, nearest {1e3 * min(least)[0]:.1f} mm ({min(least)[1]}), {alarms} alarms")
        task.close()


if __name__ == "__main__":
    main()
