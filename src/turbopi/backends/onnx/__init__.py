"""ONNX, whole: the export, and the backend that runs it."""
