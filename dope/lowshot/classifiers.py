"""Classifiers of pooled features: nearest class mean, nearest shot, logistic regression, or the embedder's own.

All episodes of all protocols are seen at once, so that a view is encoded once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from dope.common.errors import UsageError
from dope.lowshot.embedding import Embedder
from dope.lowshot.episodes import Episodes, Indices
from dope.lowshot.local import classify_locally
from dope.lowshot.support_copies import SupportCopies
from dope.lowshot.work import Work

Classifier = Literal["auto", "local", "centroid", "nearest", "logistic"]
STANDARD = tuple(name for name in get_args(Classifier) if name != "auto")
Vectors = NDArray[np.float32]


def resolve(classifier: str, embedder: Embedder) -> str:
    """The classifier that is meant: the embedder's own where "auto".

    Raises:
        UsageError: "local" and an embedder without dense features.
    """
    name = embedder.own_classifier if classifier == "auto" else classifier
    if name == "local" and not embedder.has_dense:
        raise UsageError(
            f"{embedder.name} has no dense features, and local matching compares cells",
            where="--classifier local",
            remedy="Use --classifier auto, centroid, nearest or logistic",
        )
    return name


def classify(
    name: str, embedder: Embedder, episodes: Sequence[Episodes], work: Work, copies: SupportCopies | None = None
) -> list[Indices]:
    """The predicted way (E, ways, queries) of each protocol's queries by the classifier that `resolve` found."""
    if name == "local":
        return classify_locally(embedder, episodes, work)
    with work.encoding():
        vectors = pooled_vectors(embedder, episodes, work)
        extra = copies.vectors(embedder, episodes, work) if copies is not None and name == "logistic" else None
    predictions = []
    with work.matching_time():
        for drawn in episodes:
            if name not in STANDARD:
                predictions.append(embedder.classify(vectors, drawn))
            elif name == "logistic":
                predictions.append(logistic(vectors, drawn, copies=extra, tell=work.tell))
            else:
                predictions.append({"centroid": nearest_centroid, "nearest": nearest_vector}[name](vectors, drawn))
    return predictions


def pooled_vectors(embedder: Embedder, episodes: Sequence[Episodes], work: Work) -> Vectors:
    """What the embedder makes (V, D) of all views; rows of views that no episode needs are zero.

    Raises:
        DopeError: a vector is not finite.
    """
    needed = np.unique(np.concatenate([part.ravel() for drawn in episodes for part in (drawn.query, drawn.support)]))
    vectors: Vectors | None = None
    done = 0
    for chunk, inputs in work.images(embedder, needed):
        with torch.inference_mode():
            pooled = embedder.pooled(*inputs).float().cpu().numpy()
        bad = np.flatnonzero(~np.isfinite(pooled).all(1))
        if len(bad):
            raise work.not_finite(int(chunk[bad[0]]))
        if vectors is None:
            vectors = np.zeros((len(work.views), pooled.shape[1]), np.float32)
        vectors[chunk] = pooled
        done += len(chunk)
        work.encoded += len(chunk)
        work.tell("encode", done, len(needed))
    assert vectors is not None, "episodes have views"
    return vectors


def unit(vectors: Vectors) -> Vectors:
    """Vectors (..., D) divided by their lengths; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def nearest_centroid(vectors: Vectors, episodes: Episodes) -> Indices:
    """The way (E, ways, queries) whose mean of unit shots has the greatest cosine with the query; of equal ones, the
    first.

    Args:
        vectors: (V, D) of all views, of any length.
        episodes: indices into them.
    """
    predicted = np.empty(episodes.query.shape, np.int64)
    for e, (support, query) in enumerate(zip(episodes.support, episodes.query, strict=True)):
        centroids = unit(unit(vectors[support]).mean(1))
        predicted[e] = (unit(vectors[query]) @ centroids.T).argmax(-1)
    return predicted


def nearest_vector(vectors: Vectors, episodes: Episodes) -> Indices:
    """The way (E, ways, queries) of the shot with the greatest cosine with the query; of equal ones, the first.

    Args: as for `nearest_centroid`.
    """
    predicted = np.empty(episodes.query.shape, np.int64)
    for e, (support, query) in enumerate(zip(episodes.support, episodes.query, strict=True)):
        shots = unit(vectors[support.ravel()])
        predicted[e] = (unit(vectors[query]) @ shots.T).argmax(-1) // episodes.config.shots
    return predicted


def logistic(
    vectors: Vectors,
    episodes: Episodes,
    *,
    copies: Vectors | None = None,
    tell: Callable[[str, int, int], None] | None = None,
) -> Indices:
    """The way (E, ways, queries) by multinomial logistic regression on unit vectors, fitted for every episode.

    As RFS does (Tian et al., ECCV 2020): scikit-learn, C = 1, lbfgs, at most 1,000 iterations.

    Args:
        vectors: (V, D) of all views, of any length.
        episodes: indices into them.
        copies: (V, N, D) of augmented copies of the shots, which are learnt from as well.
        tell: told ("classify", episodes done, of).
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import LogisticRegression

    predicted = np.empty(episodes.query.shape, np.int64)
    for e, (support, query) in enumerate(zip(episodes.support, episodes.query, strict=True)):
        shots = vectors[support.ravel()][:, None]  # (ways * shots, 1, D)
        if copies is not None:
            shots = np.concatenate([shots, copies[support.ravel()]], axis=1)
        ways = np.repeat(np.arange(len(support)), support.shape[1] * shots.shape[1])
        model = LogisticRegression(C=1.0, solver="lbfgs", max_iter=1000)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            model.fit(unit(shots).reshape(len(ways), -1), ways)
        predicted[e] = model.predict(unit(vectors[query].reshape(query.size, -1))).reshape(query.shape)
        if tell is not None:
            tell("classify", e + 1, len(episodes))
    return predicted
