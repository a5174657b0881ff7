"""Mixed finite elements of axisymmetric solids under rigid tools, as Taichi kernels."""
