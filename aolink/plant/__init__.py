"""The plant lifted over many fast steps, and what the camera can know of it."""
