"""Adapters of physics engines: one file an engine, all based on `tissue_sim.realtime.tool_coupling`."""
