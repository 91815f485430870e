"""The plant lifted over many fast steps, and its observability by the camera."""
