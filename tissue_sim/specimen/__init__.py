"""Specimens: one file for each shape."""

from tissue_sim.specimen.specimen import HEIGHTS, SPECIMENS, STANDARD_GRAVITY, Specimen, specimen_sizes, specimen_texts

__all__ = ["HEIGHTS", "SPECIMENS", "STANDARD_GRAVITY", "Specimen", "specimen_sizes", "specimen_texts"]
