"""Layouts of the packed records and switches of the sensitivity kernels."""

from enum import IntEnum


class ScratchRecordOffset(IntEnum):
    """Offsets in the scratch record of one quadrature point, for the batch that is evaluated.

    Attributes:
        GRADIENT: deformation gradient, 5 numbers.
        ROOT: J^(-1/3).
        ENERGY: isochoric energy density, Pa.
        STRESS: isochoric first Piola stress of the law, 5 numbers, Pa.
        SOFT_STRESS: `STRESS` with softening, 5 numbers, Pa.
        RELAXED_STRESS: `SOFT_STRESS` with relaxation, 5 numbers, Pa.
        SIZE: numbers in a record.
    """

    GRADIENT = 0
    ROOT = 5
    ENERGY = 6
    STRESS = 7
    SOFT_STRESS = 12
    RELAXED_STRESS = 17
    SIZE = 22


class StoredPointRecordOffset(IntEnum):
    """Offsets in the stored record of one quadrature point, which both sensitivity kernels use.

    Attributes:
        GRADIENT: deformation gradient, 5 numbers.
        STRESS: isochoric first Piola stress of the law, 5 numbers, Pa.
        SECOND: second Piola stress with softening (RR, RZ, ZZ, hoop), 4 numbers, Pa.
        SOFT_TANGENT: tangent with softening, 15 numbers, packed as `energy.PACKED`, Pa.
        SIZE: numbers in a record.
    """

    GRADIENT = 0
    STRESS = 5
    SECOND = 10
    SOFT_TANGENT = 14
    SIZE = 29


class SensitivityControlIndex(IntEnum):
    """Indices of `which`, the integers that control the kernels of the sensitivities.

    Attributes:
        FACTORISES: 1 if the matrix must be factorised; still 1 afterwards if the matrix is singular.
        LAYERED: 1 if a parameter changes the moduli of elements.
        SOFTENS: 1 if the material or a derivative of the material softens.
        TERMS: number of relaxation terms.
        RELAXES: 1 if a parameter changes the relaxation.
        REFINES: 1 if the iteration uses the factorisation of the step instead of one of the exact tangent.
        SETTLED: output, 1 if the iteration of `REFINES` converged.
        PASSES: number of passes of the loop in a kernel, 1.
    """

    FACTORISES = 0
    LAYERED = 1
    SOFTENS = 2
    TERMS = 3
    RELAXES = 4
    REFINES = 5
    SETTLED = 6
    PASSES = 7
