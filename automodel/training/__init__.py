"""Training images, the U-Net and its training; parts need the extra `train` (torch, onnx)."""
