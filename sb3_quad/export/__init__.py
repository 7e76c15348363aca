"""Trained policies as files that fly without this package: ONNX, TorchScript, a C header."""
