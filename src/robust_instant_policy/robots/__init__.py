"""Real arms: followers, leaders, cameras and calibration; recording and running on them.

One TOML file describes a cell, see `cell.CellConfig`. Every motion passes the checks of `motion` first.
"""
