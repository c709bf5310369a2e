"""Problems of a published benchmark, planned with mrtamp and judged by their own rules (`python -m tests.peers`).

The problems are not part of this project: the folder that holds them is named on the command line or in
MRTAMP_PEER_PROBLEMS.
"""
