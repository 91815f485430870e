"""Import of other people's data: films, telemetry and bags become recordings. The same film and settings give the
same bytes.
"""
