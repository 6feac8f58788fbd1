"""The sentence files: complete for every environment, and checked when they are read."""

import re
from pathlib import Path

import pytest

from envs.instructions import (
    Instructions,
    load_instructions,
    read_instructions,
    training_sentences,
)

ORDERS = tuple(f"{soup}_{cell}" for soup in ("onion", "tomato") for cell in (1, 2, 3, 4))
CORNERS = ("upper_left", "upper_right", "lower_left", "lower_right")
KITCHENS = {
    "center_pots": ("left", "right", "upper", "lower", *CORNERS),
    "crossway": (*CORNERS, "upper_no_dish", "lower_no_dish", "deliver_left", "deliver_right"),
    "diverse_coordination": tuple(
        f"{side}_{rule}"
        for side in ("left", "right")
        for rule in ("no_onion", "no_dish", "no_onion_no_dish", "no_delivery")
    ),
    "diverse_orders": ORDERS,
}
LEVELS = tuple(f"level_{level}" for level in range(1, 9))
STYLES = {f"overcooked/{kitchen}": styles for kitchen, styles in KITCHENS.items()}
STYLES |= {"lbf/spread": LEVELS}
STYLES |= {
    "assistive/jaco": (
        "scratch_upper_arm",
        "scratch_forearm",
        "bathe_down",
        "bathe_up",
        "feed_left",
        "feed_right",
        "drink_left",
        "drink_right",
    )
}
NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight")
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
SMALL = ("smallest", "lightest", "lowest")
LARGE = ("largest", "heaviest", "highest", "biggest", "greatest")
GOOD = '[left]\ntrain = ["Go left."]\ntest = ["To the left."]\n'


def write(folder: Path, text: str) -> Path:
    path = folder / "kitchen.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("environment", sorted(STYLES))
def test_every_style_has_as_many_training_and_test_sentences(environment):
    instructions = load_instructions(environment, STYLES[environment])
    assert tuple(instructions) == STYLES[environment]
    (number,) = {len(sentences.train) for sentences in instructions.values()}
    assert number == (300 if environment.endswith("diverse_coordination") else 40)
    for style, sentences in instructions.items():
        assert len(sentences.test) == 4, style


def test_training_sentences_come_style_by_style(tmp_path):
    text = GOOD + '[right]\ntrain = ["Go right.", "Stay right."]\ntest = ["To the right."]\n'
    instructions = read_instructions(write(tmp_path, text), ("right", "left"))
    wordings, styles = training_sentences(instructions)
    assert wordings == ["Go right.", "Stay right.", "Go left."]
    assert styles == [0, 0, 1]


def test_a_sample_of_training_sentences_is_evenly_spread():
    instructions = Instructions(tuple(str(number) for number in range(9)), ("test",))
    assert instructions.training_sample(3) == ("0", "4", "8")
    assert instructions.training_sample(1) == ("0",)
    assert instructions.training_sample(9) == instructions.training_sample() == instructions.train


@pytest.mark.parametrize("environment", sorted(KITCHENS))
def test_sentences_name_what_their_style_is_about(environment):
    words = {
        "left": ("left",),
        "right": ("right",),
        "upper": ("upper", "top", "above", " up ", "up "),
        "lower": ("lower", "bottom", "below", "down"),
        "onion": ("onion", "veg"),
        "tomato": ("tomato",),
        "dish": ("dish", "plate", "bowl", "crockery", "tableware", "porcelain"),
        "delivery": (
            *("serv", "deliver", "hand in", "window", "carry", "carried", "pass", "bring"),
            *("brought", "waiter", "runner", "customer", "guest", "hand the soups in"),
        ),
        "deliver": ("serv", "deliver", "bring", "carry soup", "hand in", "waiter", "drop"),
        "1": ("1", "one", "first", "leftmost"),
        "2": ("2", "two", "second"),
        "3": ("3", "three", "third"),
        "4": ("4", "four", "fourth", "rightmost"),
    }
    # To train with, things may be paraphrased ("what goes into the pot"); places are always named.
    things = ("onion", "tomato", "dish", "delivery", "deliver")
    for style, (train, test) in load_instructions(environment).items():
        for part in style.replace("no_", "").split("_"):
            unnamed, in_test = (
                [said for said in told if not any(word in said.lower() for word in words[part])]
                for told in (train, test)
            )
            assert not in_test, (style, part, in_test)
            paraphrased = part in things and environment == "diverse_coordination"
            most = 0.11 * len(train) if paraphrased else 0
            assert len(unnamed) <= most, (style, part, unnamed)


def test_no_sentence_of_the_crossway_is_about_a_corner():
    # A style is two arms of a cross: there are no corners, rows or arms between two others.
    arm = r"(arm|aisle|corridor|branch|lane|leg|passage|hallway|corner|quarter)"
    corner = re.compile(rf"corner|\b(upper|lower|top|bottom)[ -](left|right) {arm}\b|\brow\b")
    for style, sentences in load_instructions("overcooked/crossway").items():
        for sentence in sentences.train:
            assert not corner.search(sentence.lower()), (style, sentence)


SIDED = sorted(name for name, styles in STYLES.items() if "left" in " ".join(styles))


@pytest.mark.parametrize("environment", SIDED)
def test_a_sentence_with_left_and_right_exchanged_is_of_the_mirrored_style(environment):
    instructions = load_instructions(environment, STYLES[environment])
    style_of = {s.lower(): style for style, told in instructions.items() for s in told.train}
    pairs = 0
    for sentence, style in style_of.items():
        other = style_of.get(exchanged(sentence))
        if other is not None and exchanged(sentence) != sentence:
            pairs += 1
            assert other == exchanged(style), sentence
    assert pairs > 0


def exchanged(text: str) -> str:
    """Left for right and right for left."""
    other = {"left": "right", "right": "left"}
    return re.sub("left|right", lambda found: other[found[0]], text)


def test_sentences_of_the_arm_name_their_side_if_they_have_one():
    for style, (train, test) in load_instructions("assistive/jaco").items():
        task, place = style.split("_", 1)
        for sentence in (*train, *test):
            sides = {side for side in ("left", "right") if side in sentence.lower()}
            if task in ("feed", "drink"):
                assert place in sides, (style, sentence)
            else:
                assert not sides, (style, sentence)


def level_said(sentence: str) -> tuple[str, int]:
    """How a sentence says a level, and which: by its size, as a digit or as a word."""
    # "The one that …" says no number.
    words = re.findall(r"\w+", sentence.lower().replace("the one", ""))
    for before, word in zip(["", *words], words, strict=False):
        rank = ORDINALS.index(before) if before in ORDINALS else 0
        if word in SMALL:
            return "size", rank + 1
        if word in LARGE:
            return "size", 8 - rank
    for word in words:
        if word.isdecimal():
            return "digit", int(word)
        if word in NUMBERS:
            return "word", NUMBERS.index(word) + 1
    raise AssertionError(f"no level in {sentence!r}")


def test_sentences_of_spread_say_their_level_in_several_ways():
    for style, (train, test) in load_instructions("lbf/spread", LEVELS).items():
        for sentences in (train, test):
            said = [level_said(sentence) for sentence in sentences]
            assert {level for _, level in said} == {int(style[-1])}, style
            assert {way for way, _ in said} == {"size", "digit", "word"}, style


def test_test_sentences_of_spread_copy_no_training_frame():
    def frame(sentence: str) -> str:
        kept = [w for w in re.findall(r"\w+", sentence.lower()) if not w.isdecimal()]
        said = {*NUMBERS, *ORDINALS, *SMALL, *LARGE}
        return " ".join(word for word in kept if word not in said)

    instructions = load_instructions("lbf/spread", LEVELS).values()
    seen = {frame(sentence) for style in instructions for sentence in style.train}
    asked = {frame(sentence) for style in instructions for sentence in style.test}
    assert len(seen) > 10
    assert len(asked) == 8
    assert not seen & asked


def test_the_environment_prefix_may_be_left_out():
    assert load_instructions("crossway") == load_instructions("overcooked/crossway")


def test_the_result_follows_the_order_of_the_style_names(tmp_path):
    path = write(tmp_path, GOOD + GOOD.replace("left", "right"))
    assert tuple(read_instructions(path, ("right", "left"))) == ("right", "left")


def test_an_unknown_environment_is_refused():
    with pytest.raises(ValueError, match="no instructions for environment 'overcooked/nowhere'"):
        load_instructions("overcooked/nowhere")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[left\n", "no valid TOML"),
        ("", "at least one"),
        ('[left]\ntrain = ["Go left."]\n', "expected the two lists train and test"),
        ('[left]\ntrain = ["Go left."]\ntest = ["A."]\nmore = ["B."]\n', "found train, test, more"),
        ('left = "Go left."\n', "expected the two lists"),
        ('[left]\ntrain = []\ntest = ["To the left."]\n', "train must be a list of at least one"),
        ('[left]\ntrain = ["Go left."]\ntest = "To the left."\n', "test must be a list"),
        ('[left]\ntrain = ["Go left.", "  "]\ntest = ["A."]\n', "train holds '  '"),
        ('[left]\ntrain = ["Go left.", "Go left."]\ntest = ["A."]\n', "occurs twice"),
        ('[left]\ntrain = ["Go left."]\ntest = ["go  LEFT."]\n', "in .left. train and .left. test"),
        (GOOD + GOOD.replace("[left]", "[right]"), "in .left. train and .right. train"),
    ],
)
def test_inconsistent_files_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_instructions(write(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("names", "message"),
    [(("left", "right"), "missing: right; extra: none"), (("right",), "extra: left")],
)
def test_missing_and_extra_styles_are_named(tmp_path, names, message):
    with pytest.raises(ValueError, match=message):
        read_instructions(write(tmp_path, GOOD), names)
