"""The experiments of the chapter "Visual SLAM" (7.4) of Dellaert and Hutchinson's *Introduction to Robotics*.

The modules return plain data; `dronevio.book.plots` draws them.
"""
