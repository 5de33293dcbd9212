"""Training data, the losses and the training loop; comparison tables, fitting, the model card."""
