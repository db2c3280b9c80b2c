"""One recorded run, its figures, and what long commands share."""
