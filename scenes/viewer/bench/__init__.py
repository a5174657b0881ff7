"""Page that displays a test bench, a running recorder or a sensor and a stage, without moving anything."""
