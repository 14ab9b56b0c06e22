"""The server's own page: one HTML document, and the feed behind it, which `turbopi view` reads, too.

    http.py      the document's response: security headers; where the feed is; the key that a browser sends
    messages.py  what the feed says, as types: each message is JSON
    preview.py   one answered call, for people: thumbnails, the chunk, the state
    live.py      what the server has seen of its robots, and the watchers, to whom it sends that
    device.py    memory of the device
    page.html    the document: style and script are in it, and it loads nothing from elsewhere

Nothing here may slow a robot's answer. A call's preview is made after its answer was sent, on a thread beside the event
loop, at most PREVIEWS_A_SECOND of all robots, and only while a page is open. A watcher that reads slowly gets fewer
messages: no client waits for it.
"""
