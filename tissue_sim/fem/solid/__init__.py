"""Mixed finite elements of three-dimensional solids under rigid tools, as Taichi kernels."""
