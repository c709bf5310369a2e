"""Planners to compare with: the same scenes, samplers, collision queries, judge and cost as `mrtamp.planner`.

Make one by its name with `mrtamp.planners.make_planner`.
"""
