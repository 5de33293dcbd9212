"""The files of scored predictions: CSV, JSON and the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from crossloc3d_ros.datasets.place_sets import EvaluationSet
from crossloc3d_ros.evaluation import set_words
from crossloc3d_ros.evaluation.retrieval.gallery import gallery
from crossloc3d_ros.evaluation.retrieval.page import PageTexts, write_page
from crossloc3d_ros.evaluation.retrieval.predictions import Predictions
from crossloc3d_ros.evaluation.retrieval.results import as_csv, as_json
from crossloc3d_ros.evaluation.retrieval.scores import Scores
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages.wording import written_by
from crossloc3d_ros.types import DescriptorEncoder

PAGE, CSV, JSON = "index.html", "results.csv", "results.json"
_WORDS = {
    "simulated": (set_words.SIMULATED,),
    "simulated_small": (set_words.SIMULATED,),
    "amsterdam": (set_words.AMSTERDAM, set_words.AMSTERDAM_PLACES),
}


def write_report(
    folder: Path,
    predictions: Sequence[Predictions],
    scores: Sequence[Scores],
    main: Scores,
    evaluation_set: EvaluationSet,
    encoder: DescriptorEncoder,
    source: str,
) -> None:
    """Write the files into a folder; CrossLocError where one cannot be written.

    `scores` are those of `predictions`, in their order; `main` stands for the method. `source` names the data.
    """
    write_atomically(folder / CSV, as_csv(scores))
    write_atomically(folder / JSON, as_json(scores))
    half_extent_m = encoder.preprocessing.half_extent_m
    pictures = gallery(predictions[list(scores).index(main)], evaluation_set, half_extent_m)
    write_page(folder / PAGE, scores, main, pictures, _texts(main, evaluation_set, encoder, source))


def _texts(main: Scores, evaluation_set: EvaluationSet, encoder: DescriptorEncoder, source: str) -> PageTexts:
    ground = "none" if evaluation_set.ground is None else f"{len(evaluation_set.ground):,} scans"
    areas, weights = len(evaluation_set.area_names), main.about.weights
    return PageTexts(
        title=f"Benchmark {source}: {weights}",
        facts={
            "queries": f"{len(evaluation_set.queries):,} ground scans in {areas} area{'s' * (areas != 1)}",
            "aerial database": f"{len(evaluation_set.aerial):,} submaps",
            "ground database": ground,
            "weights": f"{weights} ({encoder.fingerprint[:12]})",
            "descriptor": f"{main.about.descriptor_size} numbers",
            "data": evaluation_set.fingerprint(),
        },
        footer=f"{written_by()} Search: exact, by faiss.",
        cloud_width_m=2.0 * encoder.preprocessing.half_extent_m,
        words=_WORDS.get(evaluation_set.name, ()),
    )
