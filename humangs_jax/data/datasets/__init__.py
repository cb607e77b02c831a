"""Data sets of captured people, one file for each layout; all are read into `subject.Subject`. See docs/datasets.md."""
