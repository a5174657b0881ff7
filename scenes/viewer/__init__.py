"""The viewer: a page on which a needle is pushed into tissue, and measurement and simulation are seen together.

Three processes: this one shows (a `Session` and a back-end such as the page), one runs the 1 kHz loop, one computes
whole test curves. What the back-end gets is a `Frame`; what it asks for is a command of the session.
"""
