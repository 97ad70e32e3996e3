"""From a trajectory of gripper triplets to joint commands, with every check made before an arm moves.

Simulated tasks and real arms share this package: kinematics, waypoint timing, and the checks.
"""
