"""Interactive viewer: a web page that shows a simulated tissue test in real time together with its measurement.

The viewer uses three processes. The first one holds the `Session` and displays its frames through a back-end such as
the page, the second one runs the 1 kHz haptic loop, and the third one computes the curves of whole tests. The session
passes a `SessionFrame` to the back-end, and the back-end posts commands to the session.
"""
