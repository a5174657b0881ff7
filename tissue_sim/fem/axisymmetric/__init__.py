"""The axisymmetric solid."""
