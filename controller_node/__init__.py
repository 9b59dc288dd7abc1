"""The controller: reduced model, LQ tracking, projected law, and the node that answers states."""
