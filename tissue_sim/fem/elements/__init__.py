"""Parts of elements that all solids share: fields, strain energies in kernels, SIMD lanes, effects at the points."""
