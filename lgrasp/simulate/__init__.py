"""Physics verdicts: does a grasp hold its objects when something pulls at them?"""
