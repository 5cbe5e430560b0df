"""Physics verdicts: whether a grasp holds its objects when something pulls at them."""
