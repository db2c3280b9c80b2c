"""One recorded run, its files and figures, and code that the long commands share."""
