"""Assembly of the derivatives of the contact forces in the matrix of a step, as Taichi functions.

Only the derivatives that have changed since the factorisation are added, so that the factorisation can be updated from
the first changed block row on.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.contact import KNOWN_RATE_COLUMNS, KnownRateColumn, RateColumn, SpanColumn
from tissue_sim.fem.linear.band import BLOCK, add_any_function, add_entry_function
from tissue_sim.fem.taichi.runtime import initialise

#: A derivative counts as changed if it differs by more than this fraction of the penalty stiffness of its point.
CHANGE_TOLERANCE = 0.01


class RateFunctions(NamedTuple):
    """Taichi functions of the derivatives of the contact forces."""

    forget_rates: object
    first_rows: object
    add_rates: object
    have_changed: object
    add_tool_rates: object


@cache
def rate_functions(slips: bool) -> RateFunctions:
    """Return the functions; without `slips` no point can slip and the matrix is symmetric."""
    ti = initialise()
    add_entry, add_any = add_entry_function(), add_any_function()

    @ti.func
    def forget_rates(count, known: ti.template()):
        """Set the derivatives that the matrix contains to zero."""
        for i in range(count):
            for k in ti.static(range(KNOWN_RATE_COLUMNS)):
                known[i, k] = 0.0

    @ti.func
    def has_changed(i, springs: ti.template(), rates: ti.template(), known: ti.template()):
        changed = 0
        for k in ti.static(range(4)):
            if ti.abs(rates[i, k] - known[i, k]) > CHANGE_TOLERANCE * springs[i]:
                changed = 1
        return changed

    @ti.func
    def have_changed(count, springs: ti.template(), rates: ti.template(), known: ti.template()):
        """Return 1 if a derivative differs from that in the matrix: a point touched, separated, stuck or slipped."""
        changed = 0
        for i in range(count):
            changed = ti.max(changed, has_changed(i, springs, rates, known))
        return changed

    @ti.func
    def first_rows(count, fresh, free, rows, nodes: ti.template(), shapes: ti.template(), springs: ti.template(),
                   slip_signs: ti.template(), rates: ti.template(), known: ti.template(), equation: ti.template()):
        """Return the first block row of the points that have changed, and of the points that slip."""
        changed, skewed = rows, rows
        for i in range(count):
            first = rows
            for a in range(shapes.shape[1]):
                for k in range(2):
                    row = equation[2 * nodes[i, a] + k]
                    if shapes[i, a] != 0.0 and row < free:
                        first = ti.min(first, row // BLOCK)
            if rates[i, RateColumn.FRICTION] > 0.0 and slip_signs[i] != 0.0:
                skewed = ti.min(skewed, first)
            if fresh == 0 and has_changed(i, springs, rates, known) == 1:
                changed = ti.min(changed, first)
        return changed, skewed

    @ti.func
    def add_rates(count, fresh, unsymmetric, free, width, nodes: ti.template(), shapes: ti.template(),
                  springs: ti.template(), rates: ti.template(), known: ti.template(), equation: ti.template(),
                  entries: ti.template(), upper: ti.template()):
        """Add the changes of the derivatives of the contact forces to the matrix; all derivatives if it is `fresh`.

        The upper half of the matrix is needed only if points slip.
        """
        for i in range(count):
            if fresh == 1 or has_changed(i, springs, rates, known) == 1:
                for a in range(shapes.shape[1]):
                    for b in range(shapes.shape[1]):
                        share = shapes[i, a] * shapes[i, b]
                        if share != 0.0:
                            for e in range(4):
                                row, column = equation[2 * nodes[i, a] + e // 2], equation[2 * nodes[i, b] + e % 2]
                                value = share * (rates[i, e] - known[i, e])
                                if ti.static(slips):
                                    if unsymmetric > 0:
                                        add_any(row, column, value, free, width, entries, upper)
                                if unsymmetric == 0:
                                    add_entry(row, column, value, free, width, entries)
                for k in ti.static(range(4)):
                    known[i, k] = rates[i, k]
                for k in ti.static(range(KNOWN_RATE_COLUMNS - KnownRateColumn.LAW_RR)):
                    known[i, KnownRateColumn.LAW_RR + k] = rates[i, RateColumn.LAW_RR + k]

    @ti.func
    def add_tool_rates(count, free, nodes: ti.template(), shapes: ti.template(), spans: ti.template(),
                       rates: ti.template(), direction: ti.template(), equation: ti.template(), pull: ti.template(),
                       reaction: ti.template()):
        """Add the derivatives of the contact forces with respect to the depth of the tool at fixed tissue to `pull`.

        The derivatives of the force on the tool with respect to the displacements are added to `reaction`. Returns the
        derivative of the force on the tool with respect to its depth at fixed tissue, N/m.
        """
        stiff = 0.0
        for i in range(count):
            krz, kzr, kzz = rates[i, RateColumn.RZ], rates[i, RateColumn.ZR], rates[i, RateColumn.ZZ]
            # Displacement of the point relative to its body per depth of the tool, with the free nodes fixed.
            apart = float(spans[i, SpanColumn.MOVES])
            for a in range(shapes.shape[1]):
                if equation[2 * nodes[i, a] + 1] >= free:
                    apart += shapes[i, a] * direction[2 * nodes[i, a] + 1]
            stiff += apart * apart * kzz
            for a in range(shapes.shape[1]):
                ir, iz, share = equation[2 * nodes[i, a]], equation[2 * nodes[i, a] + 1], shapes[i, a] * apart
                if ir < free:
                    pull[ir] = pull[ir] + share * krz
                    reaction[ir] = reaction[ir] + share * kzr
                if iz < free:
                    pull[iz] = pull[iz] + share * kzz
                    reaction[iz] = reaction[iz] + share * kzz
        return stiff

    return RateFunctions(forget_rates, first_rows, add_rates, have_changed, add_tool_rates)
