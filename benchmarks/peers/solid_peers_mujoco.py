"""Bonded punch in MuJoCo's flex, for `solid_peers`; needs only MuJoCo and NumPy.

    python -m benchmarks solid_peers_mujoco JOB.npz

The job has ``nodes`` (m), ``tetrahedra``, numbers of nodes in ``base`` and ``face``, ``depths`` (m), ``young`` (Pa),
``poisson``, ``seconds`` that a depth may take. Prints one JSON object. The flex is Saint Venant-Kirchhoff in linear
tetrahedra; its integrator ``discrete`` is implicit in the positions, so that steps of 10 ms with damping come to rest.
Nodes of the face are drawn to their places by springs that are so stiff that they give way by a few micrometres.
"""

import json
import sys
import time

import mujoco
import numpy as np

#: Time step, s.
STEP = 0.01
#: Damping time of the elasticity, s.
DAMPING = 0.1
#: Stiffness of the springs of the face, N/m.
SPRING = 1e4
#: Density, kg/m3.
DENSITY = 1000.0
#: Largest speed that counts as rest, m/s.
REST = 1e-5
MOST_STEPS = 400


def model(job: dict) -> mujoco.MjModel:
    """Return the cylinder with its base fixed to the world."""
    def words(values: np.ndarray) -> str:
        return " ".join(f"{value:.9g}" for value in np.asarray(values).ravel())

    corners = job["nodes"][job["tetrahedra"]]
    volume = float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum()) / 6.0
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{STEP}" integrator="discrete" solver="Newton" gravity="0 0 0" iterations="100"
          tolerance="1e-10"><flag contact="disable"/></option>
      <size memory="4G"/>
      <worldbody><flexcomp name="tissue" type="direct" dim="3" mass="{volume * DENSITY}" radius="1e-5"
          point="{words(job["nodes"])}" element="{words(job["tetrahedra"])}">
        <elasticity young="{job["young"]}" poisson="{job["poisson"]}" damping="{DAMPING}"/>
        <contact selfcollide="none" contype="0" conaffinity="0"/><edge equality="false"/>
        <pin id="{words(job["base"])}"/></flexcomp></worldbody></mujoco>""")


def pressed(job: dict) -> dict:
    """Return forces at the depths up to the first that is not reached, and the cost of a step."""
    built = model(job)
    data = mujoco.MjData(built)
    joints = built.body_jntadr[built.flex_vertbodyid[job["face"]]]
    addresses = built.jnt_qposadr[joints]
    for axis in range(3):
        built.jnt_stiffness[joints + axis] = SPRING
    rows, state = [], data.qpos
    for depth in job["depths"]:
        built.qpos_spring[addresses + 2] = built.qpos0[addresses + 2] - depth
        began, spent, steps = time.perf_counter(), time.process_time(), 0
        while steps < MOST_STEPS and time.perf_counter() - began < job["seconds"]:
            mujoco.mj_step(built, data)
            steps += 1
            if not np.isfinite(state).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
                return {"freedoms": int(built.nv), "rows": rows, "ended": f"no numbers at {1e3 * depth:g} mm"}
            if np.abs(data.qvel).max() < REST:
                break
        else:
            return {"freedoms": int(built.nv), "rows": rows,
                    "ended": f"not at rest after {steps} steps at {1e3 * depth:g} mm, "
                             f"{np.abs(data.qvel).max():.2g} m/s"}
        force = SPRING * float((data.qpos[addresses + 2] - built.qpos_spring[addresses + 2]).sum())
        depth_reached = float((built.qpos0[addresses + 2] - data.qpos[addresses + 2]).mean())
        rows.append({"depth": depth_reached, "force": force, "steps": steps,
                     "step_cpu_s": (time.process_time() - spent) / steps, "iterations": int(data.solver_niter[0])})
    return {"freedoms": int(built.nv), "rows": rows, "ended": ""}


def run_process() -> None:
    with np.load(sys.argv[1]) as stored:
        job = {name: stored[name] for name in stored.files}
    for name in ("young", "poisson", "seconds"):
        job[name] = float(job[name])
    print(json.dumps({"version": mujoco.__version__, **pressed(job)}))


if __name__ == "__main__":
    run_process()
