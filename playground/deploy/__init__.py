"""From a trained policy to a controller: export to ONNX with its contract, and play in plain C MuJoCo."""
