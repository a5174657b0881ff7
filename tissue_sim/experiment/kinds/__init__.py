"""Kinds of test; see `tissue_sim.experiment.kinds.kind`."""
