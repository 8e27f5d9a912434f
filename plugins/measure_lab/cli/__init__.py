"""Commands of the laboratory: rests, tips, worlds, known lengths."""
