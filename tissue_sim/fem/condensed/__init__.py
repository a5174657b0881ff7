"""Frictional contact on a linearised bulk that is condensed to the nodes near the tool (multirate simulation)."""
