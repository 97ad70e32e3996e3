"""A cell without hardware: the devices' protocols are emulated, with a simulation as their physics.

The real drivers talk to it, so a run can be tested without hardware:

driver ──serial bus, RTDE──▶ servos, controller ──commands──▶ `twin.SharedTwin` ──▶ MuJoCo, SAPIEN or a lag
"""
