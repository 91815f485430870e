"""Import of other people's data: films, telemetry and bags become recordings."""
