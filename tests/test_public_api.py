"""The public interface: each promised name is there, and asking for none of them costs nothing."""

import importlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import turbopi
from turbopi.support import errors


@pytest.mark.parametrize("name", turbopi.__all__)
def test_every_public_name_can_be_imported(name: str) -> None:
    found: dict[str, object] = {}
    exec(f"from turbopi import {name}", found)
    assert found[name] == getattr(turbopi, name)
    assert name in dir(turbopi)


def test_public_names_are_the_objects_that_their_modules_define() -> None:
    for name, module in (("UnifiedPolicy", "policy"), ("Robot", "robots"), ("open_checkpoint", "checkpoint")):
        assert getattr(turbopi, name) is getattr(importlib.import_module(f"turbopi.{module}"), name)
    assert turbopi.support.errors is errors


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *(
            ("errors", "support.errors"),
            ("client", "realtime.client"),
            ("execution", "realtime"),
            ("wire", "realtime.wire"),
        ),
        *(("model.denoise", "models.pi0.denoise"), ("serve.schedule", "serve.scheduling.schedule")),
    ],
)
def test_a_name_of_0_1_is_the_moved_module_and_warns(old: str, new: str) -> None:
    sys.modules.pop(f"turbopi.{old}", None)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = importlib.import_module(f"turbopi.{old}")
    assert found is importlib.import_module(f"turbopi.{new}")
    assert found.__spec__ is not None and found.__spec__.name == f"turbopi.{new}"
    said = {str(one.message) for one in seen if one.category is DeprecationWarning}
    assert (f"turbopi.{old} is turbopi.{new} now" in said) is (old != "errors")


def test_every_error_is_public() -> None:
    defined = {name for name, one in vars(errors).items() if isinstance(one, type) and issubclass(one, Exception)}
    assert defined <= {*turbopi.__all__}


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'turbopi' has no attribute 'UnifiedPolice'"):
        turbopi.UnifiedPolice  # noqa: B018


def test_import_turbopi_imports_neither_torch_nor_numpy() -> None:
    """Nor do the errors and the version."""
    code = "import sys, turbopi; turbopi.__version__, turbopi.TurboPiError; print({'torch', 'numpy'} & {*sys.modules})"
    here = {**os.environ, "PYTHONPATH": str(Path(turbopi.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=here)
    assert done.stdout.strip() == "set()"


def test_import_turbopi_alone_is_short() -> None:
    """Ctrl-C while it lasts shows a traceback; importlib.abc would import pathlib, urllib and more."""
    source = str(Path(turbopi.__file__).parents[1])
    code = f"import sys; sys.path.append({source!r}); import turbopi; print('pathlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-ISc", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_without_pytorch_a_policy_is_refused_in_words() -> None:
    """A robot's computer has Turbo-Pi's client alone."""
    code = "import sys; sys.modules['torch'] = None\nimport turbopi.realtime.client\nfrom turbopi import UnifiedPolicy"
    here = {**os.environ, "PYTHONPATH": str(Path(turbopi.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=here)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ImportError: turbopi.UnifiedPolicy needs PyTorch, which isn't installed: "), done.stderr
    assert last.endswith("turbopi.realtime alone, without PyTorch (docs/real_time.md)")
