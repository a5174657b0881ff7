"""The demo: the main job on a virtual specimen."""
