"""The experiments of the chapter "Visual SLAM" (7.4) of Dellaert and Hutchinson's *Introduction to Robotics*.

What comes out is plain data; how it is drawn is `dronevio.book.plots`' business.
"""
