"""Formats of image files: `size` reads the header, and `check`, or `decode` of JPEG, checks that the file is complete.

OpenCV decodes what is damaged as far as it can, and prints a warning at most. So files are checked before it sees them. Both
functions take the bytes of a file and raise a ValueError whose text is the reason, as part of a sentence.
"""
