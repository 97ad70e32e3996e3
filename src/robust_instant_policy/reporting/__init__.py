"""Pages, tables and figures: views on what runs, datasets and evaluations wrote."""
