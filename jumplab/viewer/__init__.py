"""One jump in 3-D, in one HTML file that opens in any browser, without network, server or display.

>>> from jumplab import viewer
>>> page = viewer.page(robot, plan=tape, simulation=result)
>>> page.save("jump.html")     # one file, about 1.5 MB
>>> page                       # as the last expression of a cell: embedded in the notebook
"""

from jumplab.viewer.page import FPS, Page, page

__all__ = ["FPS", "Page", "page"]
