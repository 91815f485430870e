"""Other sides of the lines that drivers speak on, each served byte by byte, which can misbehave."""
