"""Reports: tables in the form of the paper, from the raw records alone, and figures that show what is in them."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from mrtamp.bench import figures
from mrtamp.bench.cells import Column, Share, Table, escape, latex, markdown, plain, table_csv
from mrtamp.bench.compare import MEASURES, compared, comparison
from mrtamp.bench.machine import this_machine
from mrtamp.bench.records import Record, Records, Times, read_records
from mrtamp.bench.report import overhead_text, report, runs_csv, trouble_text
from mrtamp.bench.run import Point
from mrtamp.bench.statistics import Summary
from mrtamp.bench.suite import Case, Entrant, Suite
from mrtamp.bench.summary import ablation_table, everything_table, main_table, optimum_table, scalability_table
from mrtamp.cli import main
from mrtamp.problem import MrtampError

LIMIT_S = 30.0
PAIRS = ((2, 2), (2, 4), (2, 6), (3, 3), (3, 6), (4, 4), (4, 6))
SUITE = Suite(
    "example_1",
    "Costs & times of 100 % invented runs.",
    "scalability",
    tuple(Case("pick_place", LIMIT_S, {"robots": r, "objects": o}) for r, o in PAIRS),
    (Entrant("composed-prm", "Composed PRM*"), Entrant("unguided", "un_guided"), Entrant("guided", "guided")),
    (0, 1, 2, 3, 4),
)


SMALL = replace(SUITE, cases=tuple(SUITE.cases[i] for i in (0, 1, 5)), seeds=(0, 1, 2))


def invented(suite: Suite = SUITE, factor: float = 10.0) -> list[Record]:
    """Records in which the first planner needs `factor` times as long as the last, and the second finds nothing."""
    rng = np.random.default_rng(0)
    out = []
    for a in suite.assignments():
        size = a.case.parameters.get("objects", 3)
        base = 0.1 * size * rng.uniform(0.8, 1.2)
        times = Times(1.0, LIMIT_S + 0.2, 0.3, LIMIT_S + 1.7, LIMIT_S)
        rank = suite.entrants.index(a.entrant)
        slow = factor if rank == 0 else 1.0
        points = tuple(
            Point(slow * base * k, 10.0 * size / k**0.3 * (1.2 if rank == 0 else 1.0), 8.0, 12.0) for k in (1, 2, 4)
        )
        out.append(
            Record(
                key=a.key,
                case=a.case.name,
                parameters=a.case.task(a.layout).parameters,
                planner=a.entrant.label,
                seed=a.seed,
                limit_s=LIMIT_S,
                points=() if rank == 1 else points,
                first_counts={} if rank == 1 else {"collision_checks": int(slow * 1000 * size), "ik_calls": 300},
                counts={"collision_checks": 10**6, "ik_calls": 4000},
                times=times,
                peak_mb=200.0 + size,
                machine=this_machine(),
            )
        )
    return out


def saved(folder: Path, suite: Suite = SUITE, records: list[Record] | None = None) -> Path:
    with Records(folder, suite) as file:
        for record in records if records is not None else invented(suite):
            file.add(record)
    return folder


# -- tables ----------------------------------------------------------------------------------------------------------


def test_table_of_scalability_has_the_form_of_the_paper() -> None:
    table = scalability_table(SUITE, invented())
    assert [row[:2] for row in table.rows] == list(PAIRS)
    assert [group for group in table.groups] == [("", 2), ("Composed PRM*", 3), ("un_guided", 3), ("guided", 3)]
    assert [c.title for c in table.columns[2:5]] == ["SR", "T_first (s)", "J_final"]
    assert table.rules == {3, 5}
    assert table.rows[0][2] == Share(5, 5) and table.rows[0][5:8] == (Share(0, 5), None, None)
    text = latex(table)
    assert r"\begin{tabular}{cc|ccc|ccc|ccc}" in text and r"\cmidrule(lr){3-5}\cmidrule(lr){6-8}" in text
    assert r"100\%" in text and r"0\% & -- & --" in text


def test_main_table_has_the_form_of_the_paper() -> None:
    table = main_table(SUITE, invented())
    assert [row[0] for row in table.rows] == ["Composed PRM*", "un_guided", "guided"]
    assert len(table.columns) == 1 + 4 * len(PAIRS)
    assert [c.title for c in table.columns[1:5]] == ["SR", "T_first (s)", "J_first", "J_final"]
    assert r"\begin{tabular}{l" + "c" * 28 + "}" in latex(table)


def test_means_and_deviations_are_over_the_runs_with_a_plan() -> None:
    records = [r for r in invented() if r.case == "pick_place 2/2" and r.planner == "guided"]
    found = [r.points[0].time_s for r in records]
    lost = [*records[:3], *(replace(r, points=()) for r in records[3:])]
    cells = scalability_table(SUITE, lost).rows[0][8:]
    assert cells[0] == Share(3, 5)
    assert cells[1] == Summary(pytest.approx(np.mean(found[:3])), pytest.approx(np.std(found[:3], ddof=1)), 3)


def test_the_cost_at_the_end_is_that_of_the_cheapest_plan_within_the_limit() -> None:
    [record] = [r for r in invented() if r.key == "pick_place 2/2, guided, seed 0"]
    late = replace(record, points=(*record.points, Point(LIMIT_S + 1, 0.1, 0.1, 0.1)))
    cell = scalability_table(SUITE, [late]).rows[0][10]
    assert isinstance(cell, Summary) and cell.mean == record.points[-1].cost and cell.deviation is None


def test_ablation_compares_with_the_first_planner() -> None:
    table = ablation_table(SUITE, invented(factor=8.0))
    reference, _, other = table.rows[:3]
    assert reference[4] is None and other[4].value == pytest.approx(1 / 8, rel=0.1)
    assert other[8].value == pytest.approx(1 / 1.2)


def test_costs_are_divided_by_the_known_optimum() -> None:
    suite = Suite("s", "", "optimum", (Case("square_free", LIMIT_S),), (Entrant("guided", "guided"),), (0, 1))
    records = [
        Record(f"k{i}", "square_free", {}, "guided", i, LIMIT_S, (Point(1, 8.12, 8, 8), Point(2, end, 4, 4)))
        for i, end in enumerate((4.06, 4.466))
    ]
    [row] = optimum_table(suite, records).rows
    assert row[2] == "4.0600" and row[5] == Summary(pytest.approx(2.0), pytest.approx(0.0), 2)
    assert row[6:] == ("1.0500", "1.1000", "1.0000")


# -- forms of tables -------------------------------------------------------------------------------------------------


def cells_of(line: str) -> int:
    """Columns that a row of a LaTeX table fills."""
    spans = [int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
    return len(re.findall(r"(?<!\\)&", line)) + 1 + sum(n - 1 for n in spans)


@pytest.mark.parametrize("make", [main_table, scalability_table, ablation_table, everything_table])
def test_latex_is_balanced_and_escaped(make) -> None:
    text = latex(make(SUITE, invented()))
    bare = re.sub(r"\\[\\{}$&%#_]", "", text)
    assert bare.count("{") == bare.count("}") and bare.count("$") % 2 == 0
    depth = np.cumsum([{"{": 1, "}": -1}.get(c, 0) for c in bare])
    assert depth.min() >= 0 and depth[-1] == 0
    opened = Counter(re.findall(r"\\begin\{(\S+?)\}", text))
    assert opened == Counter(re.findall(r"\\end\{(\S+?)\}", text)) == {"table*": 1, "tabular": 1}
    math_free = re.sub(r"\$[^$]*\$|\\(label|begin|end)\{[^}]*\}|\{\*\}", "", bare)
    assert not set("%#_^*~±") & set(math_free)
    [columns] = re.findall(r"\\begin\{tabular\}\{([lc|]+)\}", text)
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(rows) > 3
    assert {cells_of(row) for row in rows} == {len(columns.replace("|", ""))}
    for low, high in re.findall(r"\\cmidrule\(lr\)\{(\d+)-(\d+)\}", text):
        assert 1 <= int(low) < int(high) <= len(columns.replace("|", ""))


def test_every_special_character_is_escaped() -> None:
    assert escape(r"a_b & 5 % of #1 {x} ~ ^ \ $") == (
        r"a\_b \& 5 \% of \#1 \{x\} \textasciitilde{} \textasciicircum{} \textbackslash{} \$"
    )
    assert escape("PRM* T_first") == r"PRM$^\ast$ $T_{\mathrm{first}}$"


def test_markdown_and_plain_rows_have_all_columns() -> None:
    table = Table("t", "Some.", (Column("a|b", text=True), Column("n", "up")), (("x|y", 3), ("z", None)))
    rows = [line for line in markdown(table).splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows[2:]} == {3} and rows[3] == "| z | - |"
    assert plain(table).splitlines()[-1].split() == ["z", "-"]


def test_csv_has_deviations_of_their_own() -> None:
    rows = list(csv.DictReader(io.StringIO(table_csv(scalability_table(SUITE, invented())))))
    assert [(int(r["Robots"]), int(r["Objects"])) for r in rows] == list(PAIRS)
    assert rows[0]["guided SR"] == "1.0" and float(rows[0]["guided J_final deviation"]) == pytest.approx(0.0, abs=1e-9)
    assert rows[0]["un_guided J_final"] == ""
    runs = list(csv.DictReader(io.StringIO(runs_csv(invented()))))
    assert len(runs) == 7 * 3 * 5 and runs[0]["first_collision_checks"] == "20000" and runs[1]["first_s"] == ""


# -- comparison ------------------------------------------------------------------------------------------------------


def test_ratios_of_pairs_are_what_was_put_in() -> None:
    row = comparison(SUITE, invented(factor=7.0), "guided", "Composed PRM*").rows[0]
    assert row[:3] == ("pick_place 2/2", 1, "5, 5")
    records = [r for r in invented(factor=7.0) if r.case == "pick_place 2/2"]
    logs = [
        math.log(one.points[0].time_s / two.points[0].time_s)
        for one in records
        for two in records
        if one.planner == "guided" and two.planner == "Composed PRM*" and one.seed == two.seed
    ]
    assert row[3].value == pytest.approx(math.exp(np.mean(logs)))
    assert row[3].low < 1 / 7 < row[3].high
    # J_final, and checks: the same for every seed.
    assert row[7].value == pytest.approx(1 / 1.2) and row[9].low == row[9].high == pytest.approx(1 / 7)


def test_runs_without_a_plan_count_as_their_limit_in_time_and_are_left_out_of_costs() -> None:
    records = invented()
    row = comparison(SUITE, records, "guided", "un_guided").rows[0]
    expected = [r.points[0].time_s / LIMIT_S for r in records if r.planner == "guided" and r.case == "pick_place 2/2"]
    assert row[2] == "5, 0"
    assert row[3].value == pytest.approx(math.exp(np.mean(np.log(expected)))) and row[4] == "5/5"
    assert row[5:] == (None, "0/5", None, "0/5", None, "0/5")


def test_layouts_are_paired_with_themselves() -> None:
    case = Case("pick_place", LIMIT_S, {"robots": 2, "objects": 2}, (0, 1, 2))
    suite = Suite("s", "", "main", (case,), SUITE.entrants, (0, 1))
    [row] = comparison(suite, invented(suite), "guided", "Composed PRM*").rows
    assert row[1] == 3 and row[4] == "6/6"
    assert compared([], MEASURES[0]).ratio is None


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        ("guidd", "un_guided", "did you mean 'guided'"),
        ("guided", "guided", "two different planners"),
        ("guided", "un_guided", "same seed yet"),
    ],
)
def test_what_cannot_be_compared_is_named(a: str, b: str, words: str) -> None:
    with pytest.raises(MrtampError, match=words):
        comparison(SUITE, [r for r in invented() if r.planner != "un_guided"], a, b)


# -- the whole report ------------------------------------------------------------------------------------------------


def test_a_report_made_again_is_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(tmp_path, SMALL)
    _, files = report(tmp_path)
    names = {str(file.relative_to(tmp_path)) for file in files}
    drawn = {f"figures/{n}.png" for n in ("cost_over_time", "success_over_time", "scaling_time", "scaling_checks")}
    assert names == {"report.md", "tables.tex", "table.csv", "everything.csv", "runs.csv", *drawn}
    made = [file for file in tmp_path.rglob("*") if file.is_file() and file.name != "runs.jsonl"]
    before = {file: file.read_bytes() for file in made}
    for file in made:
        file.unlink()
    assert main(["bench", "report", str(tmp_path)]) == 0
    assert {file: file.read_bytes() for file in made} == before
    assert re.search(r"^pick_place 2/4 +Composed PRM\* +3/3 ", capsys.readouterr().out, flags=re.MULTILINE)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert all((tmp_path / link).exists() for link in re.findall(r"\]\((.*?)\)", text))
    assert "27 of 27 runs" in text and "Composed PRM* divided by guided" in text and this_machine().text() in text


def test_compare_and_list_print(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(tmp_path)
    assert main(["bench", "compare", str(tmp_path), "guided", "Composed PRM*"]) == 0
    assert "| all | 7 | 35, 35 |" in capsys.readouterr().out
    assert main(["bench", "compare", str(tmp_path), "guided", "guide"]) == 2
    assert main(["bench", "report", str(tmp_path / "nowhere")]) == 2
    capsys.readouterr()
    assert main(["bench", "list"]) == 0
    assert re.search(r"^paper-scalability +105 ", capsys.readouterr().out, flags=re.MULTILINE)


@pytest.mark.filterwarnings("error")
def test_a_report_of_few_runs_and_of_none(tmp_path: Path) -> None:
    saved(tmp_path / "some", records=invented()[-3:])
    text, _ = report(tmp_path / "some")
    assert "pick_place 4/6" in text and "pick_place 2/2" not in text
    saved(tmp_path / "none", SMALL, [])
    assert report(tmp_path / "none")[1]
    half = [replace(r, points=r.points if r.seed == 0 else ()) for r in invented(SMALL) if r.seed < 2]
    saved(tmp_path / "half", SMALL, half)
    assert "cost_over_time" not in {file.stem for file in report(tmp_path / "half")[1]}
    nothing = [r for r in invented(SMALL) if r.planner == "un_guided"]
    saved(tmp_path / "failed", SMALL, nothing)
    files = report(tmp_path / "failed")[1]
    assert "success_over_time" in {file.stem for file in files} and "cost_over_time" not in {f.stem for f in files}


def test_what_went_wrong_is_said_and_changes_the_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, *rest = invented()
    wrong = replace(good, error="Traceback\nValueError: it fell over")
    refused = replace(rest[1], refused=("an arm is in the table",))
    assert trouble_text(rest) == ""
    text = trouble_text([wrong, refused])
    assert f"{good.key}: ValueError: it fell over" in text and "an arm is in the table" in text
    saved(tmp_path, records=[wrong, refused])
    assert main(["bench", "report", str(tmp_path)]) == 1
    assert "0/1" in capsys.readouterr().out


def test_overhead_is_what_is_neither_starting_nor_planning_nor_judging() -> None:
    text = overhead_text(invented())
    share = 100 * 0.2 / (LIMIT_S + 1.7)
    assert f"{share:.1f} % (0.20 s per run) into the harness" in text and "0.20 s at most" in text


# -- figures ---------------------------------------------------------------------------------------------------------


def test_figures_have_a_diagram_per_problem_and_a_legend(tmp_path: Path) -> None:
    figures.draw(SMALL, invented(SMALL), tmp_path)
    for file in tmp_path.glob("*.svg"):
        ElementTree.parse(file)
    made = {path.stem for path in tmp_path.glob("*.png")}
    assert made == {path.stem for path in tmp_path.glob("*.svg")} and len(made) == 4


def test_curves_start_where_half_of_the_runs_have_a_plan_and_bands_where_all_do() -> None:
    records = [r for r in invented() if r.case == "pick_place 2/2" and r.planner == "guided"]
    firsts = sorted(r.points[0].time_s for r in records)
    figure = figures.cost_over_time(SUITE, records)
    [axis] = figure.axes
    [curve] = [line for line in axis.get_lines() if line.get_label() == "guided"]
    step = 1.05
    assert firsts[2] <= curve.get_xdata()[0] <= firsts[2] * step
    [band] = axis.collections
    begins = band.get_paths()[0].vertices[:, 0].min()
    assert firsts[-1] <= begins <= firsts[-1] * step
    assert curve.get_ydata()[-1] == pytest.approx(np.median([r.points[-1].cost for r in records]))


def test_scaling_is_on_logarithmic_axes_with_runs_without_a_plan_at_their_limit() -> None:
    figure = figures.scaling_time(SUITE, invented())
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == ["2 robots", "3 robots", "4 robots", "4 objects", "6 objects"]
    for axis in figure.axes:
        assert axis.get_xscale() == axis.get_yscale() == "log"
        hollow = [line for line in axis.get_lines() if line.get_markerfacecolor() == "white"]
        assert hollow and all(line.get_ydata()[0] == LIMIT_S for line in hollow)


def test_records_are_all_that_a_report_needs(tmp_path: Path) -> None:
    saved(tmp_path)
    assert read_records(tmp_path) == (SUITE, invented())
