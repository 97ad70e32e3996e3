"""Pages, tables and figures about runs, datasets and evaluations."""
