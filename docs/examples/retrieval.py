"""A method of one's own: look the partner's sentence up, and play the best response stored there.

    python -m experiments.compare RUN --methods --add docs/examples/retrieval.py

Nothing is generated: the training sentence that shares most words with the partner's says which
style it has.
"""

import re

import jax

from experiments.methods import Given, Told, Trained


def words(sentence: str) -> set[str]:
    """The words of a sentence, whatever their case."""
    return set(re.findall(r"[a-z']+", sentence.lower()))


def similarity(one: set[str], other: set[str]) -> float:
    """The share of their words that two sentences have in common (Jaccard index)."""
    return len(one & other) / len(one | other)


class Retrieval:
    """Plays the best response of the style that was asked for in the most similar words."""

    budgeted = False  # no egos are trained

    def num_updates(self, run, steps):
        """One: it only reads the sentences."""
        return 1

    def train(self, given: Given) -> Trained:
        """Keeps the training sentences and the run's best responses."""
        known = [[words(sentence) for sentence in style] for style in given.sentences]
        egos = given.best_responses.actor  # leading axes [style, seed]
        seeds = given.run.config.partners.train_seeds

        def make(told: Told, key: jax.Array):
            said = words(told.sentence)
            nearest = [max(similarity(said, other) for other in style) for style in known]
            style, seed = nearest.index(max(nearest)), jax.random.randint(key, (), 0, seeds)
            return jax.tree.map(lambda leaf: leaf[style, seed], egos)

        what = "the best response of the style whose training sentences share most words"
        return Trained(egos={"Retrieval": make}, descriptions={"Retrieval": what})


METHODS = {"retrieval": Retrieval()}
