"""Every experiment runs at its smallest size and reports what it found."""

import json

import jax
import pytest

from experiments.harness import call, listed

PEOPLE = "--subjects 1 --held-out 1 --poses 1 --pose-views 1 --size 64"
CASES = {
    "accelerator": "--small",
    "evaluation_bodies": f"{PEOPLE} --views 1",
    "extremes": "--cases black",
    "fit_keypoints": "--people 1 --frames 1 --no-curves",
    "fit_sequences": "--people 2 --smoothness 0.02 --cases",
    "paper_claims": "",
    "misaligned": "--subjects 1 --held-out 1 --size 64 --centimetres 2",
    "people_faults": "--subjects 1 --size 64",
    "reconstruction_benchmark": (
        "--preset tiny --size 64 --repeats 1 --views 2 --memory 1 2 --memory-size 64"
    ),
    "refinement": (
        f"{PEOPLE} --sizes 64 --seconds 0.5 --sheet FOLDER/a.jpg --details-sheet FOLDER/b.jpg"
        " --plot FOLDER/a.png"
    ),
    "relocation": "--subjects 1 --held-out 1 --pose-views 1 --size 64 --steps 2",
    "scene_fits": "--gaussians 200 --photos 3 --size 32 24 --steps 6 --only",
    "splatting_finite_differences": "--size 32",
    "splatting": "--sizes 64 --repeats 1",
    "splatting_tradeoff": "--size 64 --repeats 1 --image FOLDER/a.png --only preset scale",
    "stability": "--types float32 --seeds 1",
    "training_cost": "--preset tiny --chips 1 --sizes 32 --variants kept",
    "training_steps": "--repeats 1 --only",
}
"""Options of each experiment."""
LAST = {
    "fit_sequences": ["all frames seen"],
    "scene_fits": ["few points, fit_scene"],
    "training_steps": ["tiny 32"],
}


@pytest.fixture(autouse=True)
def restored_options():
    names = ("jax_enable_x64", "jax_enable_compilation_cache", "jax_platforms")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_it_runs(name, tmp_path, capsys):
    options = [word.replace("FOLDER", str(tmp_path)) for word in CASES[name].split()] + LAST.get(
        name, []
    )
    assert call(function_of(name), [*options, "--json", str(tmp_path / "out.json")]) == 0
    assert "| " in capsys.readouterr().out
    stored = json.loads((tmp_path / "out.json").read_text())
    assert stored["numbers"] and stored["machine"]["cores"]
    pictures = [
        word for word in options if word.startswith(str(tmp_path)) and word[-4:] in (".png", ".jpg")
    ]
    assert all((tmp_path / picture).is_file() for picture in pictures)


def function_of(name):
    module, _ = listed()[name]
    return getattr(__import__(module, fromlist=[name]), name)
