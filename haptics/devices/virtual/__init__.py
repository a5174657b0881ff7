"""Devices that need no hardware: they behave like one, on a clock, and say what they are."""
