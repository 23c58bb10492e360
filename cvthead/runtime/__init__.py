"""The networks as onnxruntime serves them; nothing here imports torch."""
