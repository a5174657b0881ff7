"""Assembly of the derivatives of the contact forces in the matrix of a step, as Taichi functions.

Only the derivatives that have changed since the factorisation are added, so that the factorisation can be updated from
the first changed block row on.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.contact import (
    KNOWN_RATE_COLUMNS,
    ContactLinearisationColumn,
    FactorisedRateColumn,
    OutlineSpanColumn,
)
from tissue_sim.fem.linear.band import BLOCK, make_add_lower_entry_function, make_add_unsymmetric_entry_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: A derivative counts as changed if it differs by more than this fraction of the penalty stiffness of its point.
CHANGE_TOLERANCE = 0.01


class ContactStiffnessFunctions(NamedTuple):
    """Taichi functions that add the derivatives of the contact forces to the matrix of a step."""

    clear_factorised_contact_stiffness: object
    find_first_changed_and_slipping_rows: object
    add_contact_stiffness_to_matrix: object
    has_contact_stiffness_changed: object
    add_depth_derivatives_and_get_stiffness: object


@cache
def make_contact_stiffness_functions(slips: bool) -> ContactStiffnessFunctions:
    """Return the functions; if `slips` is false, no contact point can slip and the matrix is symmetric."""
    ti = get_initialised_taichi()
    add_lower_entry, add_unsymmetric_entry = make_add_lower_entry_function(), make_add_unsymmetric_entry_function()

    @ti.func
    def clear_factorised_contact_stiffness(count, surface: ti.template()):
        """Set the stored derivatives of the factorised matrix to zero, as in a matrix without contact."""
        for i in range(count):
            for k in ti.static(range(KNOWN_RATE_COLUMNS)):
                surface.known_rates[i, k] = 0.0

    @ti.func
    def has_point_stiffness_changed(i, surface: ti.template()):
        """Return 1 if a derivative of point i differs from the factorised matrix by more than `CHANGE_TOLERANCE`."""
        changed = 0
        for k in ti.static(range(4)):
            if ti.abs(surface.rates[i, k] - surface.known_rates[i, k]) > CHANGE_TOLERANCE * surface.springs[i]:
                changed = 1
        return changed

    @ti.func
    def has_contact_stiffness_changed(count, surface: ti.template()):
        """Return 1 if `has_point_stiffness_changed` holds for any point: it touched, separated, stuck or slipped."""
        changed = 0
        for i in range(count):
            changed = ti.max(changed, has_point_stiffness_changed(i, surface))
        return changed

    @ti.func
    def find_first_changed_and_slipping_rows(count, fresh, free, rows, surface: ti.template(), state: ti.template()):
        """Return the first block row with a changed contact derivative, and the first block row with a slipping point.

        Both are the number of block rows, `rows`, if there is none.
        """
        changed, skewed = rows, rows
        for i in range(count):
            first = rows
            for a in range(surface.shapes.shape[1]):
                for k in range(2):
                    row = state.equation[2 * surface.nodes[i, a] + k]
                    if surface.shapes[i, a] != 0.0 and row < free:
                        first = ti.min(first, row // BLOCK)
            if surface.rates[i, ContactLinearisationColumn.FRICTION] > 0.0 and surface.slip_signs[i] != 0.0:
                skewed = ti.min(skewed, first)
            if fresh == 0 and has_point_stiffness_changed(i, surface) == 1:
                changed = ti.min(changed, first)
        return changed, skewed

    @ti.func
    def add_contact_stiffness_to_matrix(count, fresh, unsymmetric, free, band_table: ti.template(),
                                        surface: ti.template(), state: ti.template()):
        """Add the changes of the contact derivatives to the matrix; all derivatives if the matrix is `fresh`.

        The upper half of the matrix is needed only if points slip.
        """
        for i in range(count):
            if fresh == 1 or has_point_stiffness_changed(i, surface) == 1:
                for a in range(surface.shapes.shape[1]):
                    for b in range(surface.shapes.shape[1]):
                        share = surface.shapes[i, a] * surface.shapes[i, b]
                        if share != 0.0:
                            for e in range(4):
                                row = state.equation[2 * surface.nodes[i, a] + e // 2]
                                column = state.equation[2 * surface.nodes[i, b] + e % 2]
                                value = share * (surface.rates[i, e] - surface.known_rates[i, e])
                                if ti.static(slips):
                                    if unsymmetric > 0:
                                        add_unsymmetric_entry(row, column, value, free, band_table)
                                if unsymmetric == 0:
                                    add_lower_entry(row, column, value, free, band_table)
                for k in ti.static(range(4)):
                    surface.known_rates[i, k] = surface.rates[i, k]
                for k in ti.static(range(KNOWN_RATE_COLUMNS - FactorisedRateColumn.LAW_RR)):
                    surface.known_rates[i, FactorisedRateColumn.LAW_RR + k] = surface.rates[
                        i, ContactLinearisationColumn.LAW_RR + k]

    @ti.func
    def add_depth_derivatives_and_get_stiffness(count, free, surface: ti.template(), state: ti.template()):
        """Add the derivatives of the contact forces with respect to the depth of the tool to the residual.

        They are those at fixed tissue. The derivatives of the force on the tool with respect to the displacements are
        added to `state.reaction`. Returns the derivative of the force on the tool with respect to its depth at fixed
        tissue, N/m.
        """
        stiff = 0.0
        for i in range(count):
            krz, kzr = surface.rates[i, ContactLinearisationColumn.RZ], surface.rates[i, ContactLinearisationColumn.ZR]
            kzz = surface.rates[i, ContactLinearisationColumn.ZZ]
            # Displacement of the point relative to its body per depth of the tool, with the free nodes fixed.
            apart = float(surface.spans[i, OutlineSpanColumn.MOVES])
            for a in range(surface.shapes.shape[1]):
                if state.equation[2 * surface.nodes[i, a] + 1] >= free:
                    apart += surface.shapes[i, a] * state.direction[2 * surface.nodes[i, a] + 1]
            stiff += apart * apart * kzz
            for a in range(surface.shapes.shape[1]):
                ir, iz = state.equation[2 * surface.nodes[i, a]], state.equation[2 * surface.nodes[i, a] + 1]
                share = surface.shapes[i, a] * apart
                if ir < free:
                    state.residual[ir] = state.residual[ir] + share * krz
                    state.reaction[ir] = state.reaction[ir] + share * kzr
                if iz < free:
                    state.residual[iz] = state.residual[iz] + share * kzz
                    state.reaction[iz] = state.reaction[iz] + share * kzz
        return stiff

    return ContactStiffnessFunctions(clear_factorised_contact_stiffness, find_first_changed_and_slipping_rows,
                                     add_contact_stiffness_to_matrix,
                                     has_contact_stiffness_changed, add_depth_derivatives_and_get_stiffness)
