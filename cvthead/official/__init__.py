"""The released CVTHead: import of its files, and the model as the released code runs it."""
