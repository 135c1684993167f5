"""The search over effects that a model may lack, whatever the model is of."""
