"""Seeded synthetic clothed people, written as capture folders."""

from humangs_jax.data.synthetic.seeds import SPLITS, split_of
from humangs_jax.data.synthetic.subject import SyntheticSubject, make_subject
from humangs_jax.data.synthetic.writer import synthesize, write_subject, write_training_subject

__all__ = [
    "SPLITS",
    "SyntheticSubject",
    "make_subject",
    "split_of",
    "synthesize",
    "write_subject",
    "write_training_subject",
]
