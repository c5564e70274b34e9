"""A small run of ``tests/fit/phone.py``: calibration of a phone from the target to a rendered picture."""

from tests.fit import phone
from torchdof import BlurTable


def test_a_table_of_photographs_with_an_unknown_tone_curve_renders_the_true_lens_s_picture(simulator, tmp_path):
    found, untouched = phone.measure(tmp_path, simulator, distances=(0.28, 0.4, 0.6), width=800, family="disc")
    assert found > 42 and found > untouched + 12, (found, untouched)
    table = BlurTable.load(tmp_path / "phone.json")
    assert len(table.coc) == 3 and max(map(abs, table.provenance["tone_curve"])) > 0.1
