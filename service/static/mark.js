// The IPTC mark "AI-generated" for pictures that the page itself writes as PNG.
// Renders come marked from the service; frames of a stream are told once, in its hello.

const SIGNATURE_AND_HEADER = 33;
const KEYWORD = "XML:com.adobe.xmp";

const packet = (source) =>
  '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>' +
  '<x:xmpmeta xmlns:x="adobe:ns:meta/">' +
  '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">' +
  '<rdf:Description rdf:about=""' +
  ' xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/"' +
  ' xmlns:xmp="http://ns.adobe.com/xap/1.0/">' +
  "<xmp:CreatorTool>cvthead</xmp:CreatorTool>" +
  `<Iptc4xmpExt:DigitalSourceType>${source}</Iptc4xmpExt:DigitalSourceType>` +
  '</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="r"?>';

/** A PNG blob with the mark as an iTXt chunk before its pixels. */
export async function markPng(blob, source) {
  const text = new TextEncoder().encode(`${KEYWORD}\0\0\0\0\0${packet(source)}`);
  const chunk = new Uint8Array(12 + text.length);
  const view = new DataView(chunk.buffer);
  view.setUint32(0, text.length);
  chunk.set(new TextEncoder().encode("iTXt"), 4);
  chunk.set(text, 8);
  view.setUint32(8 + text.length, crc32(chunk.subarray(4, 8 + text.length)));
  const head = blob.slice(0, SIGNATURE_AND_HEADER);
  return new Blob([head, chunk, blob.slice(SIGNATURE_AND_HEADER)], { type: "image/png" });
}

function crc32(bytes) {
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit += 1) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}
