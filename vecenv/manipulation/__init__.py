"""Geometry of hands and objects: grasps, placing, routes. For VoxPoser and the scripted policies alike."""
