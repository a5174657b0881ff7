"""Element algorithms of all solids: quadrature, SIMD lanes, laws and history in kernels, point effects, fields."""
