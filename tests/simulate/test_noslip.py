"""Friction without creep, against MuJoCo's own."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from lgrasp.runtime.device import start
from lgrasp.simulate.noslip import NoSlip, noslip

mujoco = pytest.importorskip("mujoco")

# a box and a ball that also resists twisting, on a slope; a finger presses on the box
SLOPE = """
<mujoco>
  <option timestep="0.004" cone="elliptic" jacobian="sparse" impratio="10" gravity="3 2 -9"
    noslip_iterations="{sweeps}"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" friction="0.6 0.02 0.001"/>
    <body pos="0 0 0.05"><freejoint/><geom type="box" size="0.05 0.04 0.05" condim="3" friction="0.6"/></body>
    <body pos="0.3 0 0.03"><freejoint/><geom type="sphere" size="0.03" condim="4" friction="0.4 0.01 0.001"/></body>
    <body pos="0 0 0.12"><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="1 0 0"/>
      <geom type="sphere" size="0.021" condim="4" friction="0.8 0.02 0.001"/></body>
  </worldbody>
</mujoco>"""


def at(sweeps: int, state: np.ndarray | None):
    """Model and data of MuJoCo with so many sweeps, in a state or where the bodies have come to lie."""
    m = mujoco.MjModel.from_xml_string(SLOPE.format(sweeps=sweeps))
    d = mujoco.MjData(m)
    if state is None:
        mujoco.mj_step(m, d, 40)
    else:
        mujoco.mj_setState(m, d, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(m, d)
    return m, d


def one_world(m, d) -> tuple[SimpleNamespace, SimpleNamespace]:
    """The same as MuJoCo Warp has it."""

    def ints(a):
        return wp.array(np.asarray(a, np.int32), dtype=wp.int32, device="cpu")

    def floats(a):
        return wp.array(np.asarray(a, np.float32), dtype=wp.float32, device="cpu")

    efc = SimpleNamespace(
        type=ints(d.efc_type[None]),
        id=ints(d.efc_id[None]),
        J_rownnz=ints(d.efc_J_rownnz[None]),
        J_rowadr=ints(d.efc_J_rowadr[None]),
        J_colind=ints(d.efc_J_colind[None, None]),
        J=floats(d.efc_J.reshape(1, 1, -1)),
        aref=floats(d.efc_aref[None]),
        force=floats(d.efc_force[None]),
    )
    friction = wp.array(d.contact.friction.astype(np.float32), dtype=wp.types.vector(5, wp.float32), device="cpu")
    contact = SimpleNamespace(
        dim=ints(d.contact.dim), friction=friction, efc_address=ints(d.contact.efc_address[:, None])
    )
    model = SimpleNamespace(nv=m.nv, M_rownnz=ints(m.M_rownnz), M_rowadr=ints(m.M_rowadr), M_colind=ints(m.M_colind))
    data = SimpleNamespace(
        nworld=1,
        njmax=d.nefc,
        nefc=ints([d.nefc]),
        efc=efc,
        contact=contact,
        M=floats(d.M[None]),
        qfrc_smooth=floats(d.qfrc_smooth[None]),
        qfrc_constraint=floats(d.qfrc_constraint[None]),
        qacc=floats(0 * d.qacc[None]),
    )
    return model, data


@pytest.mark.parametrize("sweeps", [1, 2, 5])
def test_forces_and_accelerations_are_those_of_mujoco(sweeps):
    start()
    m, soft = at(0, None)
    state = np.zeros(mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(m, soft, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    _, hard = at(sweeps, state)
    assert set(soft.contact.dim) == {3, 4}
    model, data = one_world(m, soft)
    with wp.ScopedDevice("cpu"):
        NoSlip(model, data, sweeps).run()
    most = np.abs(hard.efc_force - soft.efc_force).max()
    assert most > 1e-3
    np.testing.assert_allclose(data.efc.force.numpy()[0], hard.efc_force, atol=1e-2 * most)
    np.testing.assert_allclose(data.qacc.numpy()[0], hard.qacc, atol=1e-2 * np.abs(hard.qacc - soft.qacc).max())


def test_the_kernel_compiles_for_gpus(tmp_path):
    start()
    wp.compile_aot_module(noslip.module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert any(tmp_path.rglob("*.ptx"))
