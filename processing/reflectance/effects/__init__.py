"""What the model of a surface can lack: one module an effect."""
