"""Trained policies as files that fly without this package: ONNX, C, Crazyflie."""
