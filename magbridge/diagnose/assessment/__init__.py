"""The assessment: every number and verdict that a reader gets, as data, below any page that shows them.

:mod:`.numbers` measures, :mod:`.notes` says what to know before believing a finding, and :mod:`.weigh`
decides whether the extended calibration is fit for use. Texts are plain; the report marks them up.
"""
