"""What holds for every simulator, and what is said where one can't run."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from turbopi.sim import SIMULATORS, SimSettings, SimulatorUnavailable, create, graphics, libero
from turbopi.sim.base import full_suite_name
from turbopi.support.errors import ConfigError
from turbopi.support.installation import install_command


def test_an_unknown_simulator_or_suite_is_refused_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="unknown simulator 'metaworld'; choose one of libero, reacher"):
        create("metaworld")
    with pytest.raises(ConfigError, match="the simulator 'no_such_module:Sim' can't be imported"):
        create("no_such_module:Sim")
    for name in (":Sim", "no_such_module:", "..up:Sim", "json:a.b"):
        with pytest.raises(ConfigError, match="simulator"):
            create(name)
    with pytest.raises(
        ConfigError, match="unknown suite 'spatal' of libero; choose one of libero_spatial, libero_object"
    ):
        full_suite_name(create("libero"), "spatal")
    assert full_suite_name(create("libero"), "90") == full_suite_name(create("libero"), "libero_90") == "libero_90"


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("class Sim(:", "can't be imported: SyntaxError: "),
        ("import no_such_library", "can't be imported: ModuleNotFoundError: No module named 'no_such_library'"),
        ("raise OSError('no display')", "can't be imported: OSError: no display"),
        ("class Other: pass", "can't be imported: AttributeError: "),
        ("class Sim:\n    def __init__(self, scene): pass", "can't be imported: TypeError: .*scene"),
        (
            "class Sim:\n    name = 'mine'",
            "is no simulator: it has no robot, action_dim, control_hz, image_keys, suites, ",
        ),
    ],
)
def test_a_simulator_of_ones_own_that_fails_is_refused_with_the_reason(
    code: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_simulator.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "broken_simulator", raising=False)
    with pytest.raises(ConfigError, match=why):
        create("broken_simulator:Sim")


def test_without_the_extra_the_one_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libero.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulatorUnavailable, match=re.escape(install_command("libero"))):
        create("libero").check()


def test_the_renderer_is_chosen_from_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def choose(libraries: set[str], gpu: bool, **environ: str) -> str:
        monkeypatch.setattr(graphics.ctypes.util, "find_library", lambda name: name if name in libraries else None)
        monkeypatch.setattr(graphics, "_GPU_DEVICES", ("/dev/null",) if gpu else ("/dev/no-such-device",))
        return graphics.choose_renderer(environ)

    assert choose({"EGL", "OSMesa"}, gpu=True) == "egl"
    assert choose({"EGL", "OSMesa"}, gpu=False) == "osmesa"
    assert choose({"EGL"}, gpu=False) == "egl"
    assert choose({"EGL", "OSMesa"}, gpu=True, MUJOCO_GL="osmesa") == "osmesa"
    with pytest.raises(SimulatorUnavailable, match=r"neither libEGL nor libOSMesa.*apt-get install -y libosmesa6"):
        choose(set(), gpu=True)
    with pytest.raises(SimulatorUnavailable, match="MUJOCO_GL=osmesa, but libOSMesa isn't installed"):
        choose({"EGL"}, gpu=False, MUJOCO_GL="osmesa")
    with pytest.raises(SimulatorUnavailable, match="MUJOCO_GL is 'glfw'"):
        choose({"EGL"}, gpu=False, MUJOCO_GL="glfw")


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"seeding": "trial"}, "seeding='trial' isn't one; choose episode or task"),
        ({"seed": -1}, "seed=-1 should be from 0 to 4294967295"),
        ({"camera_px": 0}, "camera_px=0 should be from 16 to 4096"),
        ({"wait_steps": -1}, "wait_steps=-1 should be from 0 to 1000"),
    ],
)
def test_settings_out_of_range_are_refused(values: dict[str, int], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        SimSettings(**values)  # type: ignore[arg-type]


def test_the_episodes_seeds_differ_and_are_fixed() -> None:
    settings = SimSettings()
    seeds = {settings.episode_seed(task, state) for task in range(10) for state in range(50)}
    assert len(seeds) == 500
    assert settings.episode_seed(3, 30) == SimSettings().episode_seed(3, 30) != SimSettings(8).episode_seed(3, 30)
    assert SimSettings(seeding="task").episode_seed(3, 30) == 7


def test_the_workers_modules_import_neither_torch_nor_matplotlib() -> None:
    code = (
        "import sys, turbopi.sim.libero, turbopi.sim.reacher, turbopi.sim.chase, turbopi.evaluate.workers\n"
        "print(sorted({'torch', 'matplotlib', 'PIL', 'mujoco'} & set(sys.modules)))"
    )
    source = Path(__file__).parent.parent / "src"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=source)
    assert done.stdout.strip() == "[]"


def test_the_reacher_has_liberos_observations() -> None:
    assert set(SIMULATORS) == {"libero", "reacher", "chase"}
    reacher, settings = create("reacher"), SimSettings(camera_px=32)
    example, liberos = reacher.example(settings), create("libero").example(settings)
    assert example.keys() == liberos.keys()
    for key in ("observation/image", "observation/wrist_image", "observation/state"):
        assert (example[key].shape, example[key].dtype) == (liberos[key].shape, liberos[key].dtype)


def test_axis_angle_is_the_rotation() -> None:
    assert libero.axis_angle(np.array([0, 0, 0, 1.0])).tolist() == [0, 0, 0]
    turned = libero.axis_angle(np.array([0, 0, np.sin(0.4), np.cos(0.4)]))
    assert turned == pytest.approx([0, 0, 0.8])
    beyond = np.array([1.0, 0, 0, 1.0000001])  # rounding
    assert np.isfinite(libero.axis_angle(beyond)).all() and beyond[3] == 1.0000001
