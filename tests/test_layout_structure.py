"""The rules of the folders: who may import whom, how long a file may be, what it may be called."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("envs", "haland_jax", "experiments")
ORDER = (
    "configuration",
    "fit",
    "checkpoint",
    "networks",
    "normalisation",
    "population",
    "rollout",
    "ppo_loss",
    "learner",
    "ppo",
    "seeds",
    "partners",
    "mirrors",
    "universal",
    "recurrent",
    "recurrent_egos",
    "recurrent_ppo",
    "self_play",
    "best_responses",
    "baselines",
    "task_language",
    "hypernetwork",
    "policy_vae",
    "unet",
    "noise_schedule",
    "diffusion",
    "samplers",
    "cgan",
    "bert",
    "bert_weights",
    "translation_vae",
    "translator",
    "deployment",
    "compact",
    "pretrained",
    "behaviour_cloning",
)
FORBIDDEN = {"utils", "util", "helpers", "helper", "common", "misc", "manager"}
PYTHON_FILES = sorted(
    file for package in (*PACKAGES, "tests") for file in (ROOT / package).rglob("*.py")
)


def imported_modules(source: str) -> set[str]:
    """Dotted names of the modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide what is imported"
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def imports_of(package: str) -> dict[str, set[str]]:
    return {
        str(file.relative_to(ROOT)): imported_modules(file.read_text(encoding="utf-8"))
        for file in (ROOT / package).rglob("*.py")
    }


def test_all_forms_of_import_are_found():
    source = "import a.b\ndef f():\n    from c import d\nif True:\n    import e as f"
    assert imported_modules(source) == {"a.b", "c", "c.d", "e"}


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [("envs", ("haland_jax", "experiments", "tests")), ("haland_jax", ("experiments", "tests"))],
)
def test_packages_do_not_import_what_is_built_on_them(package, forbidden):
    imports = imports_of(package)
    assert imports, f"no python files in {package}"
    for file, modules in imports.items():
        wrong = sorted(name for name in modules if name.split(".")[0] in forbidden)
        assert not wrong, f"{file} imports {wrong}"


def test_modules_of_the_method_import_only_earlier_ones():
    for file, modules in imports_of("haland_jax").items():
        stem = Path(file).stem
        if stem == "__init__":
            continue
        assert stem in ORDER, f"{file} has no place in the import order"
        used = {name.split(".")[1] for name in modules if name.startswith("haland_jax.")}
        later = sorted(used - set(ORDER[: ORDER.index(stem)]))
        assert not later, f"{file} imports {later}, which do not come before it"


def test_no_file_is_longer_than_400_lines():
    lengths = {
        str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines())
        for file in PYTHON_FILES
    }
    too_long = {file: length for file, length in lengths.items() if length > 400}
    assert not too_long, too_long


def test_no_file_has_a_name_that_says_nothing():
    for file in PYTHON_FILES:
        words = {
            word
            for part in file.relative_to(ROOT).with_suffix("").parts
            for word in part.lower().split("_")
        }
        assert not words & FORBIDDEN, file.relative_to(ROOT)
