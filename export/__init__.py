"""A module as ONNX, checked against the module it came from."""
