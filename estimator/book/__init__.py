"""The experiments of the chapter "Visual SLAM" (7.4) of Dellaert and Hutchinson's *Introduction to Robotics*.

The modules return plain data; the modules of `dronevio.book` draw them.
"""

__all__: list[str] = []
