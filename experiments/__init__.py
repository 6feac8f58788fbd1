"""Commands, presets, stages, figures and benchmarks."""

import os

# XLA reports on every program that it loads from the compilation cache; read once, at start.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Only the tokenizers of transformers are used, so that it need not miss PyTorch.
os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")
