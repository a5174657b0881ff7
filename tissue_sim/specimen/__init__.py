"""Specimens: what is tested, one file a shape."""

from tissue_sim.specimen.specimen import HEIGHTS, SPECIMENS, STANDARD_GRAVITY, Specimen, specimen_sizes, specimen_texts

__all__ = ["HEIGHTS", "SPECIMENS", "STANDARD_GRAVITY", "Specimen", "specimen_sizes", "specimen_texts"]
