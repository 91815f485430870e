"""Other people's data in: films, telemetry and bags become recordings."""
