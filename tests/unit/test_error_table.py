"""Every error says what to do, and the table of them is the code's."""

from __future__ import annotations

from tests.error_table import CODES, messages, table


def test_the_table_holds_the_errors_of_the_code() -> None:
    texts = {message.text: message for message in messages()}
    assert len(texts) > 150
    black = texts["camera … shows only black pictures (… of … inspected)"]
    assert black.code == 3
    assert "if the lens was covered" in black.remedy
    assert any("unknown key" in text for text in texts)
    assert {message.code for message in messages()} == set(CODES.values())


WITHOUT_REMEDY = {
    "the folder contains a …, not a …",  # a store mixed up by hand; `run` rebuilds it
}


def test_every_error_says_what_to_do() -> None:
    bare = [f"{each.where}: {each.text}" for each in messages() if not each.remedy]
    assert not [line for line in bare if line.partition(": ")[2] not in WITHOUT_REMEDY]


def test_the_table_is_markdown_of_three_columns() -> None:
    for row in table().splitlines():
        assert row.replace("\\|", "").count("|") == 4, row
