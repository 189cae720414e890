"""What the package trackeval says of tracks: of files by KITTI's 2D protocol, and of overlaps alone."""

import dataclasses
import pathlib

import numpy as np
import trackeval

from jaxbox import io

METRICS = {
    "hota": trackeval.metrics.HOTA(),
    "clear": trackeval.metrics.CLEAR({"PRINT_CONFIG": False}),
    "identity": trackeval.metrics.Identity({"PRINT_CONFIG": False}),
}
NAMES = {
    "hota": {
        "hota": "HOTA", "det_a": "DetA", "ass_a": "AssA", "loc_a": "LocA",
        "det_re": "DetRe", "det_pr": "DetPr", "ass_re": "AssRe", "ass_pr": "AssPr",
    },
    "clear": {
        "mota": "MOTA", "motp": "MOTP", "recall": "CLR_Re", "precision": "CLR_Pr",
        "tp": "CLR_TP", "fn": "CLR_FN", "fp": "CLR_FP", "idsw": "IDSW", "frag": "Frag",
        "mt": "MT", "pt": "PT", "ml": "ML",
    },
    "identity": {
        "idf1": "IDF1", "idr": "IDR", "idp": "IDP", "idtp": "IDTP", "idfn": "IDFN", "idfp": "IDFP",
    },
}  # fmt: skip
"""Our names and those of trackeval."""
TOLERANCE = 1e-6


def measured(sequences):
    """Trackeval's figures of each sequence and of all together, from its own form of a sequence."""
    each = {
        name: {key: metric.eval_sequence(data) for key, metric in METRICS.items()}
        for name, data in sequences.items()
    }
    together = {
        key: metric.combine_sequences({name: parts[key] for name, parts in each.items()})
        for key, metric in METRICS.items()
    }
    return each, together


def of_comparison(comparison):
    """Trackeval's form of a sequence whose overlaps are known."""
    return {
        "num_timesteps": len(comparison.ids),
        "num_gt_ids": comparison.num_true_ids,
        "num_tracker_ids": comparison.num_ids,
        "num_gt_dets": sum(map(len, comparison.true_ids)),
        "num_tracker_dets": sum(map(len, comparison.ids)),
        "gt_ids": comparison.true_ids,
        "tracker_ids": comparison.ids,
        "similarity_scores": comparison.overlaps,
    }


def of_files(folder, labels, results, class_name):
    """Trackeval's form of sequences that it reads itself: objects by sequence, written to a folder."""
    folder = pathlib.Path(folder)
    last = {
        name: max([item.frame for item in [*labels[name], *results[name]]], default=-1) for name in labels
    }
    lengths = {name: frame + 1 for name, frame in last.items()}
    for name in labels:
        io.write_tracks(folder / "truth" / "label_02" / f"{name}.txt", labels[name])
        io.write_tracks(folder / "tracks" / "mine" / "data" / f"{name}.txt", results[name])
    seqmap = "".join(f"{name} empty 000000 {length:06d}\n" for name, length in lengths.items())
    (folder / "truth" / "evaluate_tracking.seqmap.training").write_text(seqmap)
    dataset = trackeval.datasets.Kitti2DBox(
        {
            "GT_FOLDER": str(folder / "truth"),
            "TRACKERS_FOLDER": str(folder / "tracks"),
            "CLASSES_TO_EVAL": [class_name.lower()],
            "PRINT_CONFIG": False,
        }
    )
    raw = {name: dataset.get_raw_seq_data("mine", name) for name in labels}
    return {name: dataset.get_preprocessed_seq_data(raw[name], class_name.lower()) for name in labels}


def assert_same(ours, theirs, *, but=()):
    """Every figure of ours, a dictionary with "hota", "clear" and "identity", is trackeval's."""
    for metric, names in NAMES.items():
        for name, official in names.items():
            if name not in but:
                expected = np.mean(theirs[metric][official])
                assert abs(ours[metric][name] - expected) <= TOLERANCE, (name, ours[metric][name], expected)
    for name, official in NAMES["hota"].items():
        np.testing.assert_allclose(ours["hota"]["by_alpha"][name], theirs["hota"][official], atol=TOLERANCE)


def shuffled(objects, rng):
    """The same objects in another order, with other identities."""
    ids = rng.permutation(1000)
    moved = [
        item if item.track_id == -1 else dataclasses.replace(item, track_id=int(ids[item.track_id]))
        for item in objects
    ]
    return [moved[row] for row in rng.permutation(len(moved))]
