"""Windowed moments as a measurement: of one spot on a line, of spots on a plane, of many spots of one plant."""
