"""Texts from outside are printed on one line, escaped and shortened, and warnings of libraries are printed once."""

from __future__ import annotations

import csv
import logging
import unicodedata
import warnings
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError, naming_source, shortened, shortened_repr
from ommatid.runtime.execution.library_warnings import library_warnings
from ommatid.runtime.files import write_csv
from ommatid.runtime.printable import LONGEST, LONGEST_SENTENCE, printable, printable_lines, printable_sentence

NOT_PRINTED = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
HOSTILE = st.text(
    st.one_of(
        st.characters(categories=["Cc", "Cf", "Cs", "Co", "Zl", "Zp", "Mn", "Me"]),
        st.sampled_from("ab <>&\"'$\\[]\u202e\u2066\u200b\x1b\x9b\x07漢㍿\u3164"),
        st.characters(),
    ),
    max_size=60,
)


def bad(text: str, kept: str = "") -> set[str]:
    """Characters that a terminal would not show as they are."""
    return {c for c in text if c not in kept and unicodedata.category(c) in NOT_PRINTED}


@given(HOSTILE)
def test_a_printed_text_is_one_line_of_visible_characters(text: str) -> None:
    for printed in (printable(text), printable_sentence(text), shortened(text), str(InputError(text))):
        assert not bad(printed)
        assert printable_sentence(printed) == printed, "what is printed can be printed again"
    assert not bad(printable_lines(text), "\n\t")


@given(st.text(st.characters(max_codepoint=0x24F, categories=["L", "N", "P", "S"]), max_size=80))
def test_a_plain_text_stays_as_it_is(text: str) -> None:
    assert printable(f"  {text} x") == f"  {text} x"
    assert printable_lines(f"{text}\n\t{text}") == f"{text}\n\t{text}"


@given(HOSTILE, st.integers(200, 2000))
def test_long_texts_are_cut_in_their_middle(text: str, times: int) -> None:
    long = f"begin {text * times} end"
    assert len(printable(long)) <= LONGEST
    assert len(printable_sentence(long)) <= LONGEST_SENTENCE
    if len(long) > 5 * LONGEST:
        assert printable(long).startswith("begin ")
        assert printable(long).endswith(" end")


def test_the_words_of_a_sentence_stay_beside_a_long_name() -> None:
    sentence = str(InputError(f"{'a/' * 2000}x.toml: target.shape: expected two numbers, got {'9' * 4000}; correct it"))
    assert len(sentence) <= LONGEST_SENTENCE
    assert "x.toml: target.shape: expected two numbers, got 9" in sentence
    assert sentence.endswith("9; correct it")


def test_few_marks_are_drawn_over_a_letter() -> None:
    assert printable("e\u0301\u0323") == "e\u0301\u0323"
    assert printable("e" + "\u0301" * 5) == "e" + "\u0301" * 3 + "\\u0301" * 2


@pytest.mark.parametrize(
    "value", [10**6000, [10**6000], {"a": -(10**6000)}, "\x1b" * 500, [["x" * 999] * 99] * 99], ids=type
)
def test_values_are_shortened_in_messages(value: object) -> None:
    assert len(shortened_repr(value)) <= LONGEST
    assert not bad(shortened_repr(value))


def test_a_message_names_its_file_once() -> None:
    source = Path("evil\x1b[31m\u202e.toml")
    for message in (f"{source}: wrong", "wrong"):
        with pytest.raises(InputError) as raised, naming_source(source):
            raise InputError(message)
        assert str(raised.value) == "evil\\x1b[31m\\u202e.toml: wrong"


@pytest.mark.filterwarnings("default")
def test_warnings_of_libraries_are_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    for name in ("a.library", "ommatid.simulate"):
        monkeypatch.setattr(logging.getLogger(name), "propagate", False)
    monkeypatch.delenv("OMMATID_TRACEBACK", raising=False)
    before = warnings.showwarning, logging.lastResort
    with library_warnings(said.append):
        for _ in range(3):
            warnings.warn_explicit("first\nline\x1b[31m", RuntimeWarning, "/x/site-packages/numpy/lib/a.py", 1)
            warnings.warn_explicit("second", UserWarning, "/x/ommatid/a.py", 1)
            logging.getLogger("a.library").warning("third")
            logging.getLogger("a.library").info("nothing")
            logging.getLogger("ommatid.simulate").warning("a whole sentence")
        for number in range(100):
            warnings.warn_explicit(f"number {number}", UserWarning, "/x/a.py", 1)
    assert [sentence.partition(";")[0] for sentence in said[:3]] == [
        "numpy: first line\\x1b[31m",
        "ommatid: second",
        "a: third",
    ]
    assert said[3] == "a whole sentence"
    assert len(said) == 20
    assert (warnings.showwarning, logging.lastResort) == before
    monkeypatch.setenv("OMMATID_TRACEBACK", "1")
    with library_warnings(said.append):
        assert (warnings.showwarning, logging.lastResort) == before


def test_no_text_of_a_csv_file_is_a_formula(tmp_path: Path) -> None:
    cells = ["=1+1", "@x", "+x", "-x", "-1", "+2e3", "-1.5 µm", "plain", "a\x1b\u202e", "a,b", ""]
    write_csv(tmp_path / "a.csv", ["=key"], ([cell] for cell in [*cells, -1.5]))
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as stream:
        read = [row[0] if row else "" for row in csv.reader(stream)]
    expected = ["'=1+1", "'@x", "'+x", "'-x", "-1", "+2e3", "-1.5 µm", "plain", "a\\x1b\\u202e", "a,b", ""]
    assert read == ["'=key", *expected, "-1.5"]
