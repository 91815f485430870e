"""Import of other people's data: films, telemetry and bags become recordings.

An **object** is a spot that is followed, its **place** where it is, in pixels of the film from the middle of the first
one. The **survey** is what is measured of all objects in the single frames, and the **first rig file** is made of it.
The same film and settings give the same bytes.
"""
