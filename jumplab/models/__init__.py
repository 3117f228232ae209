"""The models of the three stages: reaction mass pendulum, five links in the plane, nine links in space."""
