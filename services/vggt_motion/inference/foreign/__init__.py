"""Other projects' networks behind our predictor contract, each in its own Python environment.

Their packages pin versions that contradict ours and each other's (Depth Anything 3 wants numpy below 2), so they are
never imported into our processes: ``child.py`` runs in an interpreter of the user's choice, knows nothing of our
package, and exchanges arrays with us over its standard input and output.
"""
