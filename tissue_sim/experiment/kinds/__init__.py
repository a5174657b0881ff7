"""Kinds of test, a few in each file; `tissue_sim.experiment.kinds.kind` says what one is."""
