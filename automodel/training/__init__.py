"""Training data, the U-Net and its training; needs the extra `train` (torch, onnx) where it says so."""
