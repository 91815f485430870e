"""What the command line prints: facts and tables, by subject."""
