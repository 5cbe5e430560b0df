"""Hand room: URDF and hand.yaml -> HandModel."""
