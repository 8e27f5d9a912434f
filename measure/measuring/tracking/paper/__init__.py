"""The paper's frame-update algorithm: effective and suspended circles."""
