"""Many runs: suites of recordings × estimators, each run a process of its own and a row of a table.

What only the door can do, to fly and to estimate, is handed in as `Workshop`.
"""
