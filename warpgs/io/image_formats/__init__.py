"""Formats of image files: `size` reads the header; `check` (for JPEG, `decode`) checks that the file is complete.

OpenCV decodes damaged files as far as it can, and at most prints a warning. So files are checked first. The functions take the
bytes of a file, and raise a ValueError with the reason as part of a sentence.
"""
