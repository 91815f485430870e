"""Films and pictures in other people's files: what they show, when, and how it may be written again."""
