"""What a calibration answers: one `Fit` a law, and predictions of the held-out tests."""

from __future__ import annotations

import msgspec


class Minimum(msgspec.Struct, frozen=True, kw_only=True):
    """A local minimum of the sum of squares that some of the starts ended in.

    Attributes:
        parameters: name -> value, SI.
        R2: coefficient of determination there.
        starts: how many starts ended in it.
    """

    parameters: dict[str, float]
    R2: float
    starts: int


class Nuisance(msgspec.Struct, frozen=True, kw_only=True):
    """Contact offset and zero of one replicate, in the units of the file.

    Attributes:
        replicate: its name.
        contact_offset_mm: reported displacement at which the tool truly touches.
        zero_offset_N: reading without load.
        contact_offset_error_mm, zero_offset_error_N: standard errors; None on a bound, or where not determined.
        on_bound: names of those that ended on their bound.
    """

    replicate: str
    contact_offset_mm: float
    contact_offset_error_mm: float | None
    zero_offset_N: float
    zero_offset_error_N: float | None
    on_bound: list[str] = []


class Prediction(msgspec.Struct, frozen=True, kw_only=True):
    """A held-out test as a law predicts it.

    Attributes:
        test, law: names.
        RMSE_N: root mean square error of the force; None without a specimen.
        RMSE_Pa: of the nominal stress.
        percent: error relative to the largest measured stress.

    All None where the law does not carry a specimen that weighs as far as the test went.
    """

    test: str
    law: str
    RMSE_N: float | None
    RMSE_Pa: float | None
    percent: float | None


class Covariance(msgspec.Struct, frozen=True, kw_only=True):
    """Covariance of the parameters, SI, in a stated order."""

    order: list[str]
    matrix: list[list[float]]


class Fit(msgspec.Struct, frozen=True, kw_only=True, rename={"E0": "E0_Pa", "mu0": "mu0_Pa"}):
    """A law fitted to a campaign. Encoded, it is an entry of ``fits`` in ``fit.json``.

    Attributes:
        law, formula: name and energy.
        parameters: name -> value, SI.
        standard_errors: name -> standard deviation of the estimate; None where not determined or on a bound; 0 if
            fixed.
        covariance: of the parameters, zero for those that are fixed or on a bound. correlation: in the same order.
        covariance_from: ``"noise"``, ``"residuals"`` or ``"replicates"``: what the standard errors rest on.
        intervals95: name -> (low, high) inside the bounds, None without a standard error.
        not_identifiable: names whose standard error exceeds the value or that lie in a singular direction.
        on_bound: parameters and nuisances that ended on a bound.
        R2: of the nominal stress. RMSE_N: None without a specimen. RMSE_Pa: of the nominal stress.
        noise_ratio: root mean square of the residuals, each in units of its noise.
        AIC, BIC: with the noise taken as known and priors as penalties, up to a constant that all laws share.
        E0, mu0: initial Young's and shear modulus of the incompressible law, Pa.
        stable_from, stable_to: stretches that are Drucker-stable in all three modes of loading; stability: the same
            in words; stretch_range: of the data.
        sag_mm: specimen that weighs -> by how much it sags with this law.
        nuisances: of the replicates when offsets are fitted.
        minima: best first. starts: how many were tried.
        status: ``"converged"``, ``"unstable"`` (in the measured loading over the data), ``"not_physical"`` or
            ``"not_converged"``. Only the first is usable.
        unusable: why it is not usable over the data; None where it is.
        warnings: what to mind, usable or not: bounds that hold unknowns, loss of stability in other loading.
        message: for people; holds both.
        iterations: evaluations of the model. fem_solves: 0 for a closed form. cpu_s: processor seconds.
        material_file: name of the file, None where the fit gives no material.
    """

    law: str
    formula: str
    parameters: dict[str, float]
    standard_errors: dict[str, float | None]
    covariance: Covariance
    correlation: list[list[float]]
    covariance_from: str
    intervals95: dict[str, tuple[float, float] | None]
    not_identifiable: list[str]
    on_bound: list[str]
    R2: float
    RMSE_N: float | None
    RMSE_Pa: float
    noise_ratio: float
    AIC: float
    BIC: float
    E0: float
    mu0: float
    stable_from: float
    stable_to: float
    stability: str
    stretch_range: tuple[float, float]
    sag_mm: dict[str, float] = {}
    nuisances: list[Nuisance] = []
    minima: list[Minimum] = []
    starts: int
    status: str
    unusable: str | None = None
    warnings: list[str] = []
    message: str
    iterations: int
    fem_solves: int = 0
    cpu_s: float
    material_file: str | None = None
