"""Layout of a mode bank, of an object's estimate, and of the kernels' scratch: one record each."""

from __future__ import annotations

import numpy as np

from can_imm.estimation.particles import PARTICLE_DTYPE
from can_imm.types import MAX_STATES, VX

LOG_FLOOR = -1e30

NEGLIGIBLE_WEIGHT = 1e-12
"""A source with a smaller mixing weight does not count."""

UNREACHABLE = 1e-15
"""A mode whose prior probability is smaller is not computed; it gets the floor probability."""

NEGLIGIBLE_RISE = 0.01
"""A mode that stays below this fraction of the floor, whatever the measurement, is not computed."""

MAX_ROWS = 4
"""Largest number of constraint rows of one kind in one mode."""

SPEED_STEP = 1 << VX
"""Bit of ``entry_sources``: the entry replaces the speed ahead."""

FIXED, LANE, GROUND = 0, 1, 2
"""What the numbers of a row refer to: zero, the nearest lane centre in a range of lanes, or the
speed at which what stands still moves relative to the ego vehicle."""

UNKNOWN_GROUND = -1e3
"""Stands for the speed of the ground [m/s] where the ego's is unknown: nothing moves like that, so
that what stands still or comes towards us is never claimed."""


MAX_MODES = 24
"""Largest number of modes in a bank."""

MAX_STEPS = 201
"""Length of the tables over elapsed steps: two seconds of 10 ms."""

# The records have one fixed layout for all banks.  That spares a compilation per bank, and it has
# to be so: numba names cached functions after a record's number in the process that compiled them,
# so two layouts compiled in two processes can be taken for each other in a third.

_M, _N, _K = MAX_MODES, MAX_STATES, MAX_ROWS

BANK_DTYPE = np.dtype(
    [
        ("F", np.float64, (MAX_STEPS, _M, _N, _N)),
        ("Q", np.float64, (MAX_STEPS, _M, _N, _N)),
        ("Pi", np.float64, (MAX_STEPS, _M, _M)),
        ("mu0", np.float64, (_M,)),
        ("birth_std", np.float64, (_N,)),
        ("jump_std", np.float64, (4,)),
        ("step_s", np.float64),
        ("mu_floor", np.float64),
        ("var_floor", np.float64),
        ("lane_width", np.float64),
        ("lane_range", np.float64, (2,)),
        ("lane_prior", np.float64),
        ("rear_end_gap", np.float64),
        ("peak_speed", np.float64),
        ("soft_value", np.float64, (_M, _K)),
        ("soft_lanes", np.float64, (_M, _K, 2)),
        ("soft_r", np.float64, (_M, _K)),
        ("bound_lower", np.float64, (_M, _K)),
        ("bound_upper", np.float64, (_M, _K)),
        ("bound_lanes", np.float64, (_M, _K, 2)),
        ("entry_mean", np.float64, (_M, _N)),
        ("entry_var", np.float64, (_M, _N)),
        ("particle", PARTICLE_DTYPE),
        ("relative_lanes", np.int64),
        ("n_modes", np.int64),
        ("n_states", np.int64),
        ("manoeuvre", np.int8, (_M,)),
        ("direction", np.int8, (_M,)),
        ("off_lane", np.int8, (_M,)),
        ("is_steady", np.int8, (_M,)),
        ("is_particle", np.int8, (_M,)),
        ("is_projected", np.int8, (_M,)),
        ("n_soft", np.int8, (_M,)),
        ("soft_kind", np.int8, (_M, _K)),
        ("soft_state", np.int8, (_M, _K)),
        ("soft_density", np.int8, (_M, _K)),
        ("n_bounds", np.int8, (_M,)),
        ("bound_state", np.int8, (_M, _K)),
        ("bound_kind", np.int8, (_M, _K)),
        ("bound_mass", np.int8, (_M, _K)),
        ("entry_sources", np.int8, (_M, _M)),
    ],
    align=True,
)
"""Parameters of a mode bank as one record.

Tables are indexed by the number of elapsed steps: ``F[m]``, ``Q[m]``, ``Pi[m]`` belong to m steps;
``Pi[m, i, j]`` is the probability of going from mode i to mode j.  Bit s of ``entry_sources[i, j]``
says that state s is replaced when j is entered from i; ``entry_var`` is negative where it never is.
``soft_density``: the row's variance is ``soft_r`` divided by the time since the last measurement.
``off_lane``: what is in this mode says nothing of where the lanes are.
``rear_end_gap``: APPROACHING in the ego's lane is reported as REAR_END up to this gap [m]; 0 never.
``peak_speed``: what recedes or approaches reaches this relative speed [m/s] at some time; 0: any.
``is_steady``: who is in this mode, which holds its speed, and has not reached that does neither.
"""

OBJECT_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, _N)),
        ("P", np.float64, (_M, _N, _N)),
        ("mu", np.float64, (_M,)),
        ("log_l", np.float64, (_M,)),
        ("mean", np.float64, (_N,)),
        ("cov", np.float64, (_N, _N)),
        ("Pi", np.float64, (_M, _M)),
        ("lane_width", np.float64),
        ("lane_scans", np.float64),
        ("reached", np.float64, (2,)),
    ],
    align=True,
)
"""Estimator state of one object: per mode at its last measurement, and the combined estimate.

``Pi`` are the transition probabilities of the last cycle; a smoother goes back through them.

``lane_width`` is the distance of the lane centres that this object keeps to, learned in
``lane_scans`` scans.

``reached`` are the probabilities that it has reached the bank's peak speed since it last was about
as fast as the ego, receding and approaching.
"""

WORK_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, _N)),
        ("P", np.float64, (_M, _N, _N)),
        ("c", np.float64, (_M,)),
        ("log_c", np.float64, (_M,)),
        ("w", np.float64, (_M,)),
        ("mu", np.float64, (_M,)),
        ("tx", np.float64, (_N,)),
        ("tP", np.float64, (_N, _N)),
        ("L", np.float64, (4, 4)),
        ("lower", np.float64, (_K,)),
        ("upper", np.float64, (_K,)),
        ("var", np.float64, (_N,)),
        ("lane_width", np.float64),
        ("ground", np.float64),
        ("angle", np.float64),
        ("elapsed", np.float64),
        ("order", np.int64, (_M,)),
    ],
    align=True,
)
"""Scratch of the kernels; one record serves all objects."""
