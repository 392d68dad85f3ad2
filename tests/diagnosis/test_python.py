"""The face to Python: frames, arrays and paths where objects are, one-line errors, short representations."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from logs import as_expected, lines, signals, written

import servoscope as ss
from servoscope.core.errors import OutputError, RecordingError
from servoscope.models.loop import Columns
from servoscope.simulation import FaultEvent, reference, simulate

RIG = Path(ss.__file__).parent / "simulation" / "reference-rig.toml"


def test_arrays_and_frames_are_read_like_files() -> None:
    import pandas as pd
    import pyarrow as pa

    as_expected(ss.read(signals()))
    as_expected(ss.read(pd.DataFrame(signals())))
    as_expected(ss.read(pa.table(signals())))
    back = ss.read(signals()).to_frame()
    as_expected(ss.read(back))
    assert list(back.columns) == ["t", "r", "u", "y", "run"]
    other = {"time": signals()["t"], "y": signals()["y"], "torque": signals()["u"]}
    found = ss.read(other, columns=Columns(time="time", input="2 * torque"))
    np.testing.assert_allclose(found.u, 2.0 * signals()["u"])
    spoilt = signals() | {"u": np.where(np.arange(300) == 100, np.nan, signals()["u"])}
    assert [(d.kind, d.from_s) for d in ss.read(spoilt).defects] == [("nan", 1.0)]


def test_what_is_no_recording_is_told_in_one_line() -> None:
    with pytest.raises(TypeError, match="a path, a frame or a mapping of arrays, not from int"):
        ss.read(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a baseline is a Baseline or the path of one, not dict"):
        ss.diagnose({}, signals())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a loop is a Loop or the path of a loop file, not int"):
        ss.inspect(signals(), 3)  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=r"their lengths differ \(t 2, r 1"):
        ss.read({"t": [0.0, 1.0], "r": [0.0], "u": [0.0], "y": [0.0]})


def test_paths_stand_where_objects_do_and_what_comes_is_short(tmp_path: Path) -> None:
    loop = ss.Loop.load(RIG)
    recording = simulate(loop, reference("multisine", 20.0, loop.sample_rate), seed=1)[0]
    path = tmp_path / "healthy.csv"
    recording.to_frame().to_csv(path, index=False)
    inspection = ss.inspect(path, RIG)
    baseline = ss.learn(RIG, [path])
    baseline.save(tmp_path / "baseline.json")
    diagnosis = ss.diagnose(tmp_path / "baseline.json", path)
    assert diagnosis.verdict == "healthy"
    for shown in (loop, recording, inspection, baseline, diagnosis):
        text, table = repr(shown), shown._repr_html_()
        assert len(text) < 400 and "\n" not in text and text.startswith(type(shown).__name__)
        assert table.startswith("<table><caption>") and table.count("<tr>") >= 3
    assert "verdict: healthy" in repr(diagnosis)
    lines = str(diagnosis).splitlines()
    assert len(lines) <= 10 and lines[0].startswith("healthy.csv: 20 s") and lines[1] == "  Healthy: no change found"
    assert "<img" in diagnosis._repr_html_() and diagnosis.to_frame().empty
    # the same objects as pictures
    fleet = ss.Monitor([tmp_path / "baseline.json", baseline])
    r, u, y = (np.stack([signal, signal]) for signal in (recording.r, recording.u, recording.y))
    trace = fleet.run(fleet.init(), r, u, y)[1]
    plt.switch_backend("agg")
    upper, lower = ss.plot(recording)
    np.testing.assert_array_equal(upper.lines[1].get_ydata(), recording.y)
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), recording.u)
    (axes,) = ss.plot(trace)
    assert [line.get_label() for line in axes.lines if "t2" in str(line.get_label())] == ["t2 of 0", "t2 of 1"]
    (axes,) = ss.plot(inspection)
    assert list(axes.lines[0].get_xdata()) == [one.frequency_hz for one in inspection.frequencies]
    magnitude, phase = ss.plot(baseline)
    s = 2j * np.pi * np.asarray(magnitude.lines[0].get_xdata())  # the inverse is a polynomial in s
    H = sum(value * s**k for k, value in enumerate(baseline.theta))
    np.testing.assert_allclose(np.asarray(magnitude.lines[0].get_ydata()), np.abs(H), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(phase.lines[0].get_ydata()), np.degrees(np.unwrap(np.angle(H))), atol=1e-6)
    (axes,) = ss.plot(diagnosis)
    assert len(axes.get_yticks()) == len(baseline.names)
    plt.close("all")
    with pytest.raises(TypeError, match=r"a plot is made of a Recording, .* not of int"):
        ss.plot(3)  # type: ignore[arg-type]
    judged = ss.write_report(tmp_path / "page.html", tmp_path / "baseline.json", path)
    assert judged == diagnosis and "healthy.csv" in (tmp_path / "page.html").read_text()
    diagnosis.report(tmp_path / "same.html")
    assert "healthy.csv" in (tmp_path / "same.html").read_text()
    back = ss.Diagnosis.model_validate(diagnosis.to_dict())
    assert back == diagnosis and back.plot()[0].get_title() == "healthy.csv: healthy"
    with pytest.raises(OutputError, match=r"write_report\(path, baseline, recording\)"):
        back.report(tmp_path / "none.html")


def test_public_names_are_listed() -> None:
    assert set(dir(ss)) == {*ss.__all__, "NoveltyDetector"}


def test_a_log_leads_to_a_loop_file(tmp_path: Path) -> None:
    loop = ss.Loop.load(RIG)
    recording = simulate(loop, reference("multisine", 20.0, loop.sample_rate), seed=1)[0]
    recording.to_frame().rename(columns={"u": "cur"}).to_csv(tmp_path / "log.csv", index=False)
    proposal = ss.init(tmp_path / "log.csv", "u=cur")
    proposal.save(tmp_path / "loop.toml")
    assert str(proposal) == (tmp_path / "loop.toml").read_text() and "log.csv" in str(proposal)
    assert ss.Loop.load(tmp_path / "loop.toml").columns.input == "cur"


def test_frames_and_arrays_go_from_a_log_to_a_baseline() -> None:
    loop = ss.Loop.load(RIG)
    frame = simulate(loop, reference("multisine", 20.0, loop.sample_rate), seed=1)[0].to_frame().drop(columns="run")
    proposed = ss.init(frame)
    arrays = {name: column.to_numpy() for name, column in frame.items()}
    assert ss.init(arrays).loop.plant == proposed.loop.plant

    class Lazy:
        def collect(self) -> object:
            return frame

    one, lazy = ss.learn(proposed.loop, frame), ss.learn(proposed.loop, Lazy())
    assert one.theta == lazy.theta == ss.learn(proposed.loop, [arrays]).theta
    assert one.to_frame()["coefficient"].tolist() == list(one.names)
    assert one.to_frame()["value"].tolist() == list(one.theta) and (one.to_frame()["std"] > 0.0).all()


def test_a_name_cannot_put_markup_into_a_notebook(tmp_path: Path) -> None:
    found = ss.read(written(tmp_path, lines(), "a&b.csv"))
    assert "a&amp;b.csv" in found._repr_html_() and "a&b" in repr(found)


def test_scikit_learn_takes_recordings_as_samples() -> None:
    from sklearn.base import clone
    from sklearn.model_selection import StratifiedKFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer

    loop = ss.Loop.load(RIG)
    r = reference("multisine", 20.0, loop.sample_rate)
    leak = FaultEvent.parse("leakage=1.5@0")
    runs = [simulate(loop, r, seed=seed, faults=(leak,) if seed >= 6 else ())[0] for seed in range(9)]
    labels = np.array([1] * 6 + [-1] * 3)
    detector = ss.NoveltyDetector(loop)
    assert detector.get_params() == {"loop": loop} and clone(detector).loop == loop
    pipeline = make_pipeline(FunctionTransformer(lambda runs: [each.part(0.0, 19.0) for each in runs]), detector)
    scores = cross_val_score(pipeline, runs, labels, cv=StratifiedKFold(3), scoring="balanced_accuracy")
    np.testing.assert_array_equal(scores, 1.0)
    fitted = pipeline.fit(runs, labels)[-1]
    score = fitted.score_samples(runs)
    np.testing.assert_array_equal(np.sign(fitted.decision_function(runs)), labels)
    # the score is that of the diagnosis: above the limit in the same recordings
    assert [ss.diagnose(fitted.baseline_, runs[i]).verdict for i in (0, 8)] == ["healthy", "fault"]
    assert score[:6].min() > fitted.offset_ > score[6:].max()
