"""A cell without hardware: the devices' wires are emulated, with a simulation as their physics.

The real drivers talk to it, so that a run can be rehearsed:

driver ──serial bus, RTDE──▶ servos, controller ──commands──▶ `twin.SharedTwin` ──▶ MuJoCo, SAPIEN or a lag
"""
