"""Recognise tables of dynamic moduli over frequency, amplitude or temperature (rheometer, DMA)."""

from __future__ import annotations

import re
from collections.abc import Sequence

#: Pattern of headers of dynamic moduli and of the loss factor, lower case, without unit: G', G'', E', |G*|, tan delta.
_MODULUS = re.compile(
    r"\b(storage|loss|complex|dynamic|elastic shear|viscous) modul(us|i)\b|\bspeichermodul\w*|"
    r"\bverlust(modul|faktor)\w*|\bmodule (de |d )?(conservation|stockage|perte|complexe)\b|"
    r"\btan ?\(?(delta|δ)\)?|\bloss factor\b|\bcomplex viscosity\b|"
    r"\bkomplexe\w* (modul|viskosität|schubmodul)\b|^\|?[ge]\*\|?(?!\w)|^[ge] ?['′’´`]{1,2}(?!\w)|^[ge] ?[\"″”](?!\w)|"
    r"^[ge][ _](double )?prime\b|^[ge]p{1,2}(?!\w)")
#: Pattern of headers of the quantity over which the moduli are measured.
_SWEPT = re.compile(r"\b(angular )?frequenc(y|ies)\b|\b(kreis)?frequenz\b|\bfréquence\b|\bomega\b|^ω|^f(req)?(?!\w)|"
                    r"\bamplitude\w*|\boscillation (strain|stress)\b|\bscher(dehnungs)?amplitude\w*|\bstrain amp\w*")


def is_frequency_or_amplitude_sweep(headers: Sequence[str]) -> bool:
    """Return whether the headers of a table are those of moduli over frequency or amplitude.

    Such a table has two dynamic moduli, or one modulus and the quantity over which the modulus is measured.
    """
    names = [" ".join(header.casefold().replace("_", " ").split()) for header in headers]
    moduli = sum(bool(_MODULUS.search(name)) for name in names)
    swept = sum(bool(_SWEPT.search(name)) for name in names)
    amplitudes = sum("amplitude" in name or "oscillation" in name for name in names)
    return moduli >= 2 or (moduli >= 1 and swept >= 1) or swept > amplitudes > 0


def explain_refused_sweep(headers: Sequence[str]) -> str:
    """Return the reason why a table of a sweep is not imported, in one sentence."""
    named = ", ".join(repr(header) for header in headers if header)
    return (f"moduli over frequency or amplitude are not a recording of a motion (columns {named}); give displacement "
            "and force, or strain and stress, against time")
