"""Diagnosis of a misfit: regions of disagreement, missing effects, and further experiments that separate them."""
