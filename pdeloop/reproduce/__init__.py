"""The paper's whole experiment."""
