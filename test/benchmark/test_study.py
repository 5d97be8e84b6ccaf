"""What studies share: sections of pages, tables, rates."""

import pytest

from benchmark.study import Rate, image_size, table, write_figures, write_section


def test_only_the_section_of_a_page_is_written_anew(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text('head\n<!-- a -->\nold\n<!-- end of a -->\n<!-- figures -->\nold\n')
    write_section(page, 'a', r'new \1')
    write_figures(page, ['1', '2'])
    assert page.read_text() == (
        'head\n<!-- a -->\nnew \\1\n<!-- end of a -->\n<!-- figures -->\n1\n2\n'
    )


def test_tables_have_as_many_columns_as_names():
    assert table('a | b', [(1, 'x')]) == ['| a | b |', '|---|---|', '| 1 | x |']
    assert table(' | b', [], numbers=True)[1] == '| --- | ---: |'


def test_rates_have_exact_intervals():
    rate = Rate.of([True] * 9 + [False])
    assert str(rate) == '90.0 % (9/10)'
    assert rate.interval == pytest.approx((0.5550, 0.9975), abs=1e-4)
    assert str(Rate.of([])) == '-' and Rate.of([]).bounds == '0.0 to 100.0 %'


def test_image_sizes_are_read():
    assert image_size('1280x800') == (1280, 800)
