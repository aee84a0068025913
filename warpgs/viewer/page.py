"""The page of viser as the viewer serves it: parameters of its address have no effect, and only its own scripts run."""

from __future__ import annotations

NO_PARAMETERS = "URLSearchParams=class extends URLSearchParams{constructor(){super()}set(){}};"
"""JavaScript that runs before viser's own, so that address parameters have no effect and none is added. Some of them, such as
``websocket`` and ``playbackPath``, name servers and files to load."""
NO_TEXT_AS_CODE = (
    "{const made=Function,nothing=()=>{},make=args=>args.length>1?made(...args):nothing;"
    "eval=nothing;Function=new Proxy(made,{apply:(f,self,args)=>make(args),construct:(f,args)=>make(args)})}"
)
"""JavaScript that runs before viser's own, so that JavaScript in messages does nothing. The content policy cannot do this,
since the code that sorts Gaussians makes functions from text, too; functions with parameters are still allowed."""
_MARK_LOADED = (
    "document.createElement=function(name,...rest){"
    "const made=Document.prototype.createElement.call(this,name,...rest);"
    "if(name==='script'){made.nonce='NONCE';delete document.createElement}return made};"
)
"""JavaScript that gives the nonce to the one script that viser's page unpacks."""


def live_page(text: str, nonce: str) -> str:
    """Return viser's page for a content policy that only runs scripts with a nonce.

    Args:
        text: The page of viser.
        nonce: Word of the policy, of letters that are safe in an attribute.
    """
    own = f"<script>{NO_PARAMETERS}{NO_TEXT_AS_CODE}{_MARK_LOADED.replace('NONCE', nonce)}</script>"
    return text.replace("<head>", f"<head>{own}", 1).replace("<script", f'<script nonce="{nonce}"')
