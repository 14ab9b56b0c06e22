"""The server's own page: one HTML document, and the feed behind it, which `turbopi view` reads, too.

    http.py      the document's response: security headers; where the feed is; the key that a browser sends
    messages.py  what the feed says, as types: each message is JSON
    look.py      one answered call as people look at it: thumbnails, the chunk, the state
    live.py      what the server has seen of its robots, and the watchers, to whom it sends that
    device.py    memory of the device
    page.html    the document: style and script are in it, and it loads nothing from elsewhere

Nothing here may slow a robot's answer. A call is looked at after its answer was sent, on a thread beside the event
loop, at most LOOKS_A_SECOND of all robots, and only while somebody watches. A watcher that reads slowly gets fewer
messages: none waits for it.
"""
