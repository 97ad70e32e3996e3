"""The studio: a page in the browser in which a person demonstrates a task, sees a plan, and lets the arm execute it.

The page draws a `Cell` and knows no simulator; `Session` runs the cell in real time in one thread.
"""
