"""The facts and tables that the command line prints, by subject."""
