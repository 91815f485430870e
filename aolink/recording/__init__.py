"""MCAP files of sessions: written, read, compared, and made anew with other estimates.

`pages/recording_format.md` is for other software. A file may be malicious: `aolink.limits` bounds what its reading
costs, `sound` finds messages that are impossible. Live and offline exposures are assembled by the same code
(`exposures`), so that estimates agree bit for bit. `topics.TOPICS` has all that modules know of a topic.
"""
