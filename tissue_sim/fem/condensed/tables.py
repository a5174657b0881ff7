"""Index enumerations and sizes of the packed arrays of the contact on a condensed bulk."""

from enum import IntEnum

from tissue_sim.fem.taichi.runtime import LANES, VECTORS


class KernelSetting(IntEnum):
    """Indices of `settings`: inputs of the contact kernel, and the switches that the kernel resets.

    Attributes:
        COUNT: number of nodes of the model.
        CHANGEABLE: positive if nodes may change their contact state.
        NEGLIGIBLE: largest friction force that is neglected, N.
        TOLERANCE: largest violation of a contact condition, m.
        PRESSED_IN: 1 if the tool is at or below its height at the first touch, else 0.
        RELEASE: positive if held nodes under tension are released.
        REBUILDS: positive if the matrix of the linear equations must be assembled.
        MODULUS: shear modulus of the material, Pa.
        PREDICTED: number of nodes whose forces are first extrapolated with the motion of the tool.
        NEAR_COUNT: number of leading nodes that are evaluated; 0 evaluates all and determines this number.
        NEAR_GAP: gap below which a node belongs to the evaluated nodes, m.
        ROTATION: rotation matrix of the tool, 9 numbers by rows.
        ORIGIN: position of the tool in the frame of the mesh, 3 numbers, m.
        MOTION: translation (m) and rotation vector of the tool from the pose of the model, 6 numbers.
        STEP: translation (m) and rotation vector of the tool from its pose in the last step, 6 numbers.
    """

    COUNT = 0
    CHANGEABLE = 1
    NEGLIGIBLE = 2
    TOLERANCE = 3
    PRESSED_IN = 4
    RELEASE = 5
    REBUILDS = 6
    MODULUS = 7
    PREDICTED = 8
    NEAR_COUNT = 9
    NEAR_GAP = 10
    ROTATION = 11
    ORIGIN = 20
    MOTION = 23
    STEP = 29


#: Size of `settings`.
SETTING_COUNT = KernelSetting.STEP + 6


class KernelResult(IntEnum):
    """Indices of `results`: outputs of one iteration of the contact kernel.

    Attributes:
        VIOLATION: largest violation of a contact condition, m.
        PULLING: number of held nodes under tension.
        UNBALANCED: square of the norm of the change of the forces, N2.
        SIZE: square of the norm of the forces, N2.
        ACTIVE: number of nodes in the linear equations.
        REBUILT: positive if the matrix was assembled.
        SLIPPING: number of slipping nodes.
        TRAVEL: largest displacement component of a node relative to the tool since all nodes were evaluated, m.
    """

    VIOLATION = 0
    PULLING = 1
    UNBALANCED = 2
    SIZE = 3
    ACTIVE = 4
    REBUILT = 5
    SLIPPING = 6
    TRAVEL = 7


#: Size of `results`.
RESULT_COUNT = len(KernelResult)


# Taichi takes 0.3 us for each array argument when a kernel starts, so the data of the nodes are packed in few arrays.
class SurfaceNodeColumn(IntEnum):
    """Columns of `surface`, constants of the nodes of the surface.

    Attributes:
        POSITION: undeformed position, 3 numbers, m.
        PENALTY: penalty stiffness over the shear modulus, m.
        FRICTION: coefficients of friction of the tool's face and of its shaft, 2 numbers.
    """

    POSITION = 0
    PENALTY = 3
    FRICTION = 4


class NodeForceAndAnchorColumn(IntEnum):
    """Columns of `carried`: forces and anchors of the surface nodes, which continue from step to step.

    Attributes:
        FORCE: force on the tool, 3 numbers, N.
        ANCHOR: position in the frame of the tool where the node is bound, 3 numbers, m.
        NEW_ANCHOR: `ANCHOR` of the next step if this step converges, 3 numbers, m.
    """

    FORCE = 0
    ANCHOR = 3
    NEW_ANCHOR = 6


#: Number of columns of `carried`.
NODE_COLUMNS = NodeForceAndAnchorColumn.NEW_ANCHOR + 3


class NodeBondAndStatusColumn(IntEnum):
    """Columns of `states`, the contact states of the nodes of the surface.

    Attributes:
        BOND: bond to the tool, a `tissue_sim.fem.contact.pairs.ContactBondState`.
        NEW_BOND: `BOND` of the next step if this step converges.
        PRESSED: 1 if the node is in contact.
        SLIPS: 1 if the node slips against friction.
        OUTLINE: index of the outline that the node meets.
    """

    BOND = 0
    NEW_BOND = 1
    PRESSED = 2
    SLIPS = 3
    OUTLINE = 4


#: Number of columns of `states`.
STATE_COLUMNS = len(NodeBondAndStatusColumn)


class NodeListColumn(IntEnum):
    """Columns of `lists`: lists of node indices; the table has one row for each node of the model.

    Attributes:
        NODE: index of the node in the surface.
        STATUS: the node's `ContactStatus` in the last linear equations; -1: none yet.
        ACTIVE: list of the nodes in the linear equations.
        LOADED: list of the nodes that carry a force.
        NEAR: list of the nodes near the tool.
        UNKNOWN: list of the nodes in the equations of a `TangentPlaneContact`.
        FIRST_ROW: first equation of each node of `UNKNOWN`.
        ROWS: number of equations of each node of `UNKNOWN`.
    """

    NODE = 0
    STATUS = 1
    ACTIVE = 2
    LOADED = 3
    NEAR = 4
    UNKNOWN = 5
    FIRST_ROW = 6
    ROWS = 7


#: Number of columns of `lists`.
LIST_COLUMNS = len(NodeListColumn)


class ContactStatus(IntEnum):
    """Contact status of a node in the linear equations.

    Attributes:
        SEPARATED: no contact, no equation.
        FRICTIONLESS: normal force only.
        SLIPPING: normal force and Coulomb friction along the slip.
        HELD: no motion relative to the tool.
        STICKING: normal force and tangential force below the limit of friction.
    """

    SEPARATED = 0
    FRICTIONLESS = 1
    SLIPPING = 2
    HELD = 3
    STICKING = 4


class LinearisedContactColumn(IntEnum):
    """Columns of `local`: gap, force and force derivatives (linearised contact) of each node of the model.

    Attributes:
        FORCE: force at the beginning of the evaluation, 3 numbers, N.
        NORMAL: outward unit normal of the tool, 3 numbers.
        SLIP: displacement from the anchor, 3 numbers, m.
        GAP: signed distance from the tool, m.
        FRICTION: coefficient of the active friction.
        STIFFNESS: derivative of the force with respect to the position of the node, 3 x 3 by rows, N/m.
        ROTATION: derivative of the force with respect to its previous value (rotation of the slip direction), 3 x 3.
        INTERCEPT: augmented force f_0 of the linear equations, 3 numbers, N.
        ARM: position of the node relative to the tool, 3 numbers, m.
        REFERENCE: position in the frame of the tool when all nodes were evaluated, 3 numbers, m.
    """

    FORCE = 0
    NORMAL = 3
    SLIP = 6
    GAP = 9
    FRICTION = 10
    STIFFNESS = 11
    ROTATION = 20
    INTERCEPT = 29
    ARM = 32
    REFERENCE = 35


#: Number of columns of `local`.
LOCAL_COLUMNS = LinearisedContactColumn.REFERENCE + 3
#: Maximum number of displacement components, three for each node.
MAX_FREEDOMS = LANES * VECTORS
#: Number of right-hand sides: one of the iteration and six of the motions of the tool.
RIGHT_HAND_SIDES = 7
